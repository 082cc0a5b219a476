"""``demandops request``: book demand requests from files, without ROS."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import asdict, dataclass, replace
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
from demandops.cli.changes import ledger_change
from demandops.cli.changes.ledger_change import started_generator
from demandops.cli.json_output import faults_of, output_option, print_json
from demandops.cli.output import console, done, errors, progress
from demandops.cli.queries.diff import release_lines
from demandops.cli.target import dry_run_option, hint_to_pull, signing_option, writable_repo_option
from demandops.decide.decision import decide
from demandops.model.demand.goals import form_faults, is_demand_goal
from demandops.repo import reader
from demandops.serve.approvals.proposal import parse_waiting_text
from demandops.serve.generator import Generator
from demandops.serve.journal import Receipt
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

    def as_release(self) -> Document:
        goal = self.goal
        if not isinstance(goal, dict):  # the check of goals refuses it later
            return self
        if not is_demand_goal(goal):
            return replace(self, goal={**goal, "shutdown": True})
        names = ("apiVersion", "kind", "demand", "request", "requesters")
        given = {name: goal[name] for name in names if name in goal}
        return replace(self, goal=given | {"operation": "release"})


class _Answer(Future["Receipt | dict[str, str]"]):
    # the receipt, or the proposal that awaits approval

    def of(self, generator: Generator, document: Document, wait: bool) -> _Answer:
        def listen(stage: str, text: str) -> None:
            if stage != "proposed":
                return
            if wait:
                errors.print(f"{document.file}: request '{document.request_id}' {text}")
            elif not self.done():
                self.set_result(parse_waiting_text(text))

        def finish(future: Future[Receipt]) -> None:
            if self.done():  # the proposal was the answer
                return
            if (error := future.exception()) is not None:
                self.set_exception(error)
            else:
                self.set_result(future.result())

        generator.submit(document.goal, listener=listen).future.add_done_callback(finish)
        return self

    def row(self, index: int, document: Document) -> Json:
        try:
            result = self.result(timeout=0)
        except (ShuttingDown, TimeoutError):  # the command was interrupted
            return _row(index, document.request_id, "waiting")
        except Unsound:  # it is not known whether the request was booked
            raise
        except DemandOpsError as error:
            return _refused(index, document, error)
        if not isinstance(result, Receipt):
            return _row(index, document.request_id, "proposed", proposal=result)
        names = ("commit", "warnings", "not_held", "placed")
        more = {name: getattr(result, name) for name in names}
        return _row(index, result.request_id, result.outcome, **more)


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE…")
@writable_repo_option
@dry_run_option
@click.option(
    "--release", is_flag=True, help="Release the demands of the documents instead of booking them."
)
@click.option(
    "--wait",
    is_flag=True,
    help="Wait for the decision on demands that need approval. Without this option, the command "
    "ends once they are proposed, and the next generator that starts on this machine for this "
    "state repo continues with them.",
)
@signing_option
@output_option
def request(
    files: tuple[str, ...],
    state_repo: str,
    dry_run: bool,
    release: bool,
    wait: bool,
    signing_key: Path | None,
    output: str,
) -> None:
    """Book demand requests from files.

    FILE contains goals of the action DeploymentRequest as YAML, as for `ros2 action send_goal`, or
    documents of the kind Demand (docs/demand.md). Write - for standard input. If the command cannot
    parse one of the documents, it books none. Otherwise it books the documents in order. If one of
    them is refused, the command still books the others.

    \b
    Examples:
      demandops request visit.yaml
      demandops request visit.yaml --dry-run
      demandops request visit.yaml --release
      demandops request - --wait
    """
    documents = []
    for file in files:
        name, text = read_input(file)
        goals = enumerate(strict_yaml.load_all(text, name))
        documents += [Document(name, goal, text, at) for at, goal in goals if goal is not None]
    if release:
        documents = [document.as_release() for document in documents]
    if not documents:
        raise InvalidInput([fault("", f"no request in {', '.join(files)}; write one")])
    if any(form_faults(document.goal) for document in documents):
        rows = [_unbooked(index, document) for index, document in enumerate(documents)]
    elif dry_run:
        rows = _dry_run(documents, state_repo, output)
    else:
        rows = _book(documents, state_repo, wait, signing_key)
    if output == "json":
        print_json(rows)
    else:
        _print_rows(rows, documents, dry_run)
    unanswered = sum(_is_unanswered(row) for row in rows) if not dry_run else 0
    if unanswered:
        errors.print(f"{len(rows) - unanswered} of {len(rows)} requests have an answer")
        raise click.Abort
    if any(row["outcome"] == "refused" for row in rows):
        raise click.exceptions.Exit(1)


def _is_unanswered(row: Json) -> bool:
    # a request that waits for room on a node has an answer: the commit that records the wait
    return row["outcome"] == "waiting" and row["commit"] is None


def _row(index: int, request_id: str, outcome: str, **more: object) -> Json:
    return {
        "index": index,
        "request": request_id,
        "outcome": outcome,
        "commit": None,
        "faults": [],
        "warnings": [],
        "not_held": [],
        "placed": [],
    } | more


def _unbooked(index: int, document: Document) -> Json:
    message = "not booked, because another request of the same command cannot be parsed"
    faults = form_faults(document.goal) or [fault("", message)]
    return _refused(index, document, InvalidInput(faults))


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
    answers: list[_Answer] = []
    has_started = False
    try:
        with started_generator(state_repo, signing_key) as generator, progress("booking") as report:
            has_started = True
            for document in documents:
                answers.append(_Answer().of(generator, document, wait))
            for number, answer in enumerate(answers, start=1):
                ledger_change.await_answer(answer)
                report(number, len(documents))
    except KeyboardInterrupt:
        if not has_started:
            raise
    if len(answers) < len(documents):
        answers.append(_Answer())  # it may be in the journal already
    for _ in documents[len(answers) :]:
        unsent = _Answer()
        unsent.set_exception(Withdrawn("was not sent, because of the interrupt; send it again"))
        answers.append(unsent)
    pairs = enumerate(zip(documents, answers, strict=True))
    rows = [answer.row(index, document) for index, (document, answer) in pairs]
    done.extend(
        f"request '{one_line(row['request'])}' {row['outcome']} in {row['commit']}"
        for row in rows
        if row["commit"]
    )
    return rows


def _dry_run(documents: list[Document], state_repo: str, output: str) -> list[Json]:
    rows = []
    with reader.opened(state_repo) as repo, progress("reading the ledger") as report:
        repo.refuse_other_render_version()
        state = repo.snapshot(progress=report).state
        # each request is decided as if the requests before it were booked
        committed, written = repo.file_reader(), dict[str, str | None]()

        def read(path: str) -> str | None:
            return written[path] if path in written else committed(path)

        for index, document in enumerate(documents):
            try:
                decision = decide(state, document.goal, REAL.now(), read)
            except InvalidInput as error:
                rows.append(_refused(index, document, error))
                continue
            state = decision.state
            written.update(decision.files)
            outcome = "proposed" if decision.approval else decision.outcome
            if output == "text":
                console().print(f"Request {index}: '{decision.request.id}' would be {outcome}")
                for rule in decision.approval:
                    console().print(f"  needs approval: {rule} requires it")
                lines = [*release_lines(decision.releases)]
                for path, text in sorted(decision.files.items()):
                    lines.append(f"{'remove' if text is None else 'write '} {path}")
                for line in lines:
                    console().print(f"  {line}", soft_wrap=True)
            more: Json = {
                "warnings": decision.warnings,
                "not_held": decision.changes.not_held,
                "placed": decision.placed,
                "releases": [asdict(release) for release in decision.releases],
                "files": sorted(decision.files),
            }
            more |= {"approval": decision.approval} if decision.approval else {}
            rows.append(_row(index, decision.request.id, outcome, **more))
    return rows


def _print_rows(rows: list[Json], documents: list[Document], dry_run: bool) -> None:
    out = console()
    for row, document in zip(rows, documents, strict=True):
        title = f"{document.file}: request {row['index']} '{one_line(row['request'])}'"
        if not dry_run and _is_unanswered(row):
            errors.print(f"{title} has no answer yet")
        elif row["outcome"] == "refused":
            errors.print(f"{title} refused")
            for each in row["faults"]:
                errors.print(f"  {Fault(**each)}")
        elif not dry_run:
            told, proposal = f"{row['outcome']} in {row['commit']}", row.get("proposal")
            if proposal is not None:
                told = f"awaiting approval {proposal['branch']} {proposal['link']}".rstrip()
            out.print(f"{title} {told}", soft_wrap=True)
        for choice in row["placed"]:
            out.print(f"  {choice}", soft_wrap=True)
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
        for line in hint_to_pull():
            errors.print(line)
