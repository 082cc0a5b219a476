"""``demandops demand``: book the demands of files in a state repo, or send them to a node."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click

from demandops.base import strict_yaml
from demandops.base.errors import (
    DemandOpsError,
    Fault,
    InvalidInput,
    ShuttingDown,
    Unsound,
    Withdrawn,
    fault,
)
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL
from demandops.base.strict_yaml import read_input
from demandops.cli import target
from demandops.cli.changes.ledger_change import await_answer, consequence_of, started_generator
from demandops.cli.changes.person_change import confirm
from demandops.cli.formats import faults_of, output_option, print_json
from demandops.cli.output import busy, done, errors, say
from demandops.cli.queries.commits import release_lines
from demandops.decide.decision import Decision, decide
from demandops.decide.state import effects_of
from demandops.model.config.base_model import duration_text
from demandops.model.demand.goals import form_faults, is_demand_goal
from demandops.repo import reader
from demandops.repo.load.snapshot import refuse_other_render_version
from demandops.serve.generator import Generator
from demandops.serve.journal import Receipt
from demandops.serve.proposal import parse_waiting_text
from demandops.views.vocabulary import Json


@dataclass(frozen=True, slots=True)
class Document:
    file: str
    goal: Any
    text: str  # of the whole file
    number: int  # of the document in the file, from 0

    @property
    def request_id(self) -> str:
        goal = self.goal if isinstance(self.goal, dict) else {}
        id = goal.get("id") or goal.get("request") or goal.get("demand") or ""
        return id if isinstance(id, str) else ""


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE…", type=click.Path(allow_dash=True))
@click.option(
    "--via",
    type=click.Choice(["git", "ros"]),
    is_eager=True,  # over ROS, no state repo is needed
    help="Book directly in the state repo (git), or send to a running node (ros). Default: git, if "
    "a state repo is at hand.",
)
@target.optional_repo_option
@target.dry_run_option
@click.option("--release", is_flag=True, help="Release the demands of the documents instead.")
@click.option("-y", "--yes", is_flag=True, help="With --release, do not ask.")
@click.option("--renew", is_flag=True, help="Renew the demands of the documents instead.")
@click.option(
    "--hold",
    is_flag=True,
    is_eager=True,
    help="Over ROS: renew the demands until Ctrl-C, then release them.",
)
@click.option(
    "--wait",
    is_flag=True,
    help="Wait for the decision on demands that need approval. Without this option, the command "
    "ends once they are proposed, and the next generator that starts on this machine for this "
    "state repo continues with them.",
)
@click.option("--action", metavar="NAME", help="Over ROS: the name of the node's action.")
@click.option(
    "--timeout",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="Over ROS: how long to wait for the node and its answer together. Default: 60.",
)
@target.signing_option
@output_option
def demand(  # noqa: PLR0912, PLR0913, PLR0917 - each is an option
    files: tuple[str, ...],
    via: str | None,
    state_repo: str,
    dry_run: bool,
    release: bool,
    yes: bool,
    renew: bool,
    hold: bool,
    wait: bool,
    action: str | None,
    timeout: float | None,
    signing_key: Path | None,
    output: str,
) -> None:
    """FILE contains documents of the kind Demand (docs/demand.md), or goals of the action
    DeploymentRequest as YAML, as for `ros2 action send_goal`. Write - for standard input. With a
    state repo at hand, the command books directly in it; otherwise, and with --via ros, it sends
    the goals over ROS 2 to a running node. If it cannot parse one of the documents, it takes none.
    Otherwise it takes the documents in order, also if one is refused.

    \b
    Examples:
      demandops demand visit.yaml
      demandops demand visit.yaml --dry-run
      demandops demand visit.yaml --release
      demandops demand visit.yaml --via ros --hold
      demandops demand - --wait
    """
    if hold + release + renew > 1:
        raise click.UsageError("--hold, --release and --renew cannot be combined")
    of_ros = hold or action is not None or timeout is not None
    over_ros = via == "ros" or (via is None and (of_ros or not state_repo))
    if over_ros and (dry_run or wait):
        needs = f"{'--dry-run' if dry_run else '--wait'} needs a state repo, and not --via ros"
        raise click.UsageError(f"{needs}; {target.NO_STATE_REPO}")
    if not over_ros and of_ros:
        raise click.UsageError("--hold, --action and --timeout are for --via ros")
    if not over_ros and not state_repo:
        raise click.UsageError(target.NO_STATE_REPO)
    documents = []
    for file in files:
        name, text = read_input(file)
        for number, goal in enumerate(strict_yaml.load_all(text, name)):
            # what is no mapping is refused later, by the check of goals
            if (release or renew) and isinstance(goal, dict):
                if is_demand_goal(goal):
                    kept = ("apiVersion", "kind", "demand", "request", "requesters")
                    goal = {key: goal[key] for key in kept if key in goal}  # noqa: PLW2901
                    goal["operation"] = "release" if release else "renew"
                else:
                    goal["shutdown"] = release
            if goal is not None:
                documents.append(Document(name, goal, text, number))
    if not documents:
        raise InvalidInput([fault("", f"no demand in {', '.join(files)}; write one")])
    is_unread = any(form_faults(document.goal) for document in documents)
    if over_ros and not is_unread:
        rows = _send(documents, hold, action, timeout, output)
    else:
        if is_unread:
            message = "not booked, because another request of the same command cannot be parsed"
            not_booked = [fault("", message)]
            rows = [
                _refused(index, document, InvalidInput(form_faults(document.goal) or not_booked))
                for index, document in enumerate(documents)
            ]
        elif dry_run:
            rows = _dry_run(documents, state_repo, output)
        else:
            if release and not yes:
                decided = [each for _, _, each in _decided(documents, state_repo)]
                for line in consequence_of(
                    [each for each in decided if isinstance(each, Decision)]
                ):
                    errors.print(line)
                confirm("Continue?", yes)
            rows = _book(documents, state_repo, wait, signing_key)
        _show_rows(rows, documents, output, dry_run)
    if via is None and output == "text" and not is_unread:
        way = f"directly in the state repo {state_repo}; to send it to a node: --via ros"
        errors.print("(by a node, over ROS)" if over_ros else f"({way})")
    if unanswered := 0 if dry_run else sum(map(_is_unanswered, rows)):
        errors.print(f"{len(rows) - unanswered} of {len(rows)} requests have an answer")
        raise click.Abort
    if any(row["outcome"] in ("refused", "unknown") for row in rows):
        raise click.exceptions.Exit(1)


def _send(
    documents: list[Document], hold: bool, action: str | None, timeout: float | None, output: str
) -> list[Json]:
    kinds = {is_demand_goal(document.goal) for document in documents}
    if hold and False in kinds:
        raise click.UsageError("--hold is for documents of the kind Demand")
    if action and len(kinds) > 1:
        raise click.UsageError("--action names one action; send the goals of the other apart")
    # only here, because booking works without ROS
    from demandops.cli.main import imported  # noqa: PLC0415

    ros = imported("demand", "demandops_ros.demand_command")
    goals = [document.goal for document in documents]
    rows = []

    def tell(text: str) -> None:
        if output == "text":
            errors.print(text)

    with ros.sent(goals, hold, action, timeout, tell) as answers:
        for index, (document, answer) in enumerate(zip(documents, answers, strict=True)):
            if isinstance(answer, DemandOpsError):
                rows.append(_refused(index, document, answer))
                # nobody knows whether a demand is booked whose answer did not come in time
                if any(each["code"] == "timeout" for each in rows[-1]["faults"]):
                    rows[-1]["outcome"] = "unknown"
            else:
                rows.append(_row(index, document.request_id, **answer))
                done.append(f"{answer['outcome']} in {answer['commit']}")
        _show_rows(rows, documents, output, dry_run=False)
    return rows


def _is_unanswered(row: Json) -> bool:
    # a request that waits for room on a node has an answer: the commit that records the wait
    return row["outcome"] == "waiting" and row["commit"] is None


def _row(index: int, request_id: str, outcome: str, **more: Any) -> Json:  # noqa: ANN401
    return {
        "index": index,
        "request": request_id,
        "outcome": outcome,
        "commit": None,
        "faults": [],
        "warnings": [],
        "not_held": [],
        "placed": [],
        "effects": [],
    } | more


def _refused(index: int, document: Document, error: DemandOpsError) -> Json:
    lines = strict_yaml.lines(document.text, document.number)
    faults = [
        each | {"line": strict_yaml.nearest(each["field"], lines)} if not each["file"] else each
        for each in faults_of(error)
    ]
    return _row(index, document.request_id, "refused", faults=faults)


def _book(
    documents: list[Document], state_repo: str, wait: bool, signing_key: Path | None
) -> list[Json]:
    # of each document, the receipt, or the proposal that awaits approval
    answers: list[Future[Receipt | dict[str, str]]] = []

    def submit(generator: Generator, document: Document) -> None:
        answer = Future[Receipt | dict[str, str]]()

        def listen(stage: str, text: str) -> None:
            if stage == "proposed" and wait:
                errors.print(f"{document.file}: request '{document.request_id}' {text}")
            elif stage == "proposed" and not answer.done():
                answer.set_result(parse_waiting_text(text))

        def finish(future: Future[Receipt]) -> None:
            if answer.done():  # the proposal was the answer
                return
            if (error := future.exception()) is not None:
                answer.set_exception(error)
            else:
                answer.set_result(future.result())

        generator.submit(document.goal, listener=listen).future.add_done_callback(finish)
        answers.append(answer)

    has_started = False
    try:
        with started_generator(state_repo, signing_key) as generator, busy("booking") as report:
            has_started = True
            for document in documents:
                submit(generator, document)
            for number, answer in enumerate(answers, start=1):
                await_answer(answer)
                report(number, len(documents))
    except KeyboardInterrupt:
        if not has_started:
            raise
    rows = []
    for index, document in enumerate(documents):
        if index > len(answers):
            unsent = Withdrawn("was not sent, because of the interrupt; send it again")
            rows.append(_refused(index, document, unsent))
            continue
        try:
            # the next one after those that were submitted may be in the journal already
            result = answers[index].result(timeout=0) if index < len(answers) else None
        except (ShuttingDown, TimeoutError):  # the command was interrupted
            result = None
        except Unsound:  # it is not known whether the request was booked
            raise
        except DemandOpsError as error:
            rows.append(_refused(index, document, error))
            continue
        if result is None:
            rows.append(_row(index, document.request_id, "waiting"))
        elif not isinstance(result, Receipt):
            rows.append(_row(index, document.request_id, "proposed", proposal=result))
        else:
            names = ("commit", "warnings", "not_held", "placed", "effects")
            more = {name: getattr(result, name) for name in names}
            rows.append(_row(index, result.request_id, result.outcome, **more))
    done.extend(
        f"request '{one_line(row['request'])}' {row['outcome']} in {row['commit']}"
        for row in rows
        if row["commit"]
    )
    return rows


def _decided(
    documents: list[Document], state_repo: str
) -> Iterator[tuple[int, Document, Decision | InvalidInput]]:
    with reader.opened(state_repo) as repo, busy("reading the ledger") as report:
        refuse_other_render_version(repo.objects, repo.repository.tip())
        state = repo.snapshot(progress=report).state
        # each request is decided as if the requests before it were booked
        committed, written = repo.file_reader(), dict[str, str | None]()

        def read(path: str) -> str | None:
            return written[path] if path in written else committed(path)

        for index, document in enumerate(documents):
            try:
                decision = decide(state, document.goal, REAL.now(), read)
            except InvalidInput as error:
                yield index, document, error
                continue
            state = decision.state
            written.update(decision.files)
            yield index, document, decision


def _dry_run(documents: list[Document], state_repo: str, output: str) -> list[Json]:
    rows = []
    for index, document, decision in _decided(documents, state_repo):
        if isinstance(decision, InvalidInput):
            rows.append(_refused(index, document, decision))
            continue
        outcome = "proposed" if decision.approval else decision.outcome
        if output == "text":
            say(f"Request {index}: '{decision.request.id}' would be {outcome}")
            lines = [f"needs approval: {rule} requires it" for rule in decision.approval]
            lines += release_lines(decision.releases)
            for path, text in sorted(decision.files.items()):
                lines.append(f"{'remove' if text is None else 'write '} {path}")
            for line in lines:
                say(f"  {line}")
        more: Json = {
            "warnings": decision.warnings,
            "not_held": decision.changes.not_held,
            "placed": decision.placed,
            "effects": (*effects_of(decision.releases),),
            "releases": [asdict(release) for release in decision.releases],
            "files": sorted(decision.files),
        }
        more |= {"approval": decision.approval} if decision.approval else {}
        rows.append(_row(index, decision.request.id, outcome, **more))
    return rows


def _show_rows(  # noqa: PLR0912 - a part of a row each
    rows: list[Json], documents: list[Document], output: str, dry_run: bool
) -> None:
    if output == "json":
        print_json(rows)
        return
    for row, document in zip(rows, documents, strict=True):
        title = f"{document.file}: request {row['index']} '{one_line(row['request'])}'"
        if not dry_run and _is_unanswered(row):
            errors.print(f"{title} has no answer yet")
        elif row["outcome"] in ("refused", "unknown"):
            known = "refused" if row["outcome"] == "refused" else "has no known outcome"
            errors.print(f"{title} {known}")
            by_text: dict[str, list[Fault]] = {}  # one reason may refuse several parts of a demand
            for each in sorted(row["faults"], key=lambda fault: fault["line"] or 0):
                by_text.setdefault(each["message"], []).append(Fault(**each))
            for first, *others in by_text.values():
                places = f"; so are {', '.join(each.field for each in others)}" if others else ""
                errors.print(f"  {first}{places}")
        elif not dry_run:
            told = row["outcome"] + (f" in {row['commit']}" if row["commit"] else "")
            if row.get("lease"):
                told += f", for {duration_text(row['lease'])} unless renewed"
            if proposal := row.get("proposal"):
                told = f"awaiting approval {proposal['branch']} {proposal['link']}".rstrip()
            say(f"{title} {told}")
        for told in (*row["placed"], *(() if dry_run else row["effects"])):
            say(f"  {told}")
        warnings = [*row["warnings"]]
        lease = document.goal.get("lease") if isinstance(document.goal, dict) else None
        if isinstance(lease, int) and not isinstance(lease, bool):
            # it counts as seconds, but its author may have meant minutes
            told = f"lease: {lease} is {lease} seconds; write the unit, like {lease}s or {lease}m"
            warnings.insert(0, told)
        for warning in warnings:
            errors.print(f"  warning: {warning}")
        for item in row["not_held"]:
            errors.print(f"  listed, but not held by the requester: {item}")
    if not dry_run and any(row["outcome"] in ("booked", "released") for row in rows):
        for line in target.hint_to_pull():
            errors.print(line)
    codes = {each["code"] for row in rows for each in row["faults"]}
    for line in target.hint_to_push() if codes & {"unknown-application", "unknown-node"} else ():
        errors.print(line)
