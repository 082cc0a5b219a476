"""What people end or restore in the ledger: ``release``, ``decommission`` and ``rollback``."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from demandops.base.errors import InvalidInput, Refused, StateRepoError
from demandops.base.naming import SubjectKind
from demandops.base.runtime import REAL
from demandops.base.settings import MAIN_BRANCH
from demandops.cli.changes.person_change import (
    Options,
    changing,
    confirm,
    consequence,
    warned_if_unnamed,
)
from demandops.cli.formats import show
from demandops.cli.output import busy, done, errors, fitted, terminal_width
from demandops.cli.queries.commits import resolved
from demandops.cli.target import name_options, names_of, options_for
from demandops.decide.decision import Decision, decide
from demandops.decide.state import State
from demandops.model.config.config import CONFIG_ROOTS
from demandops.model.demand import goals
from demandops.model.demand.demand import Decommission, Rollback
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import ClaimChange
from demandops.repo import reader
from demandops.repo.history import commit_log
from demandops.repo.load.ledger_files import restoration
from demandops.repo.reader import Reader
from demandops.serve.generator import Generator
from demandops.views.vocabulary import Json, claim_data

# ---- a booking: decide, show what follows, ask, and book ----

# A person who waits at a terminal is told soon that the server refuses every commit.
_REFUSAL_PATIENCE_S = 4.0


def await_answer(future: Future[Any]) -> None:
    # Polled, so that Ctrl-C and SIGTERM interrupt it: a wait without a timeout could miss a signal
    # that arrives just before the wait begins, or a signal that another library handles.
    while not future.done():
        wait([future], timeout=0.5)


@contextmanager
def started_generator(state_repo: str, signing_key: Path | None) -> Iterator[Generator]:
    with busy("reading the ledger") as report:
        generator = Generator(
            state_repo,
            requester_limit=None,  # the command is its only client
            start_offline=False,
            signing_key=signing_key,
            refusal_patience_s=_REFUSAL_PATIENCE_S,
            progress=report,
        )
    try:
        yield generator
    finally:
        if not generator.close(timeout=0):
            errors.print(
                "accepted demands that are not published stay in the journal (`demandops "
                "journal` lists them); the next generator that starts on this machine for this "
                "state repo continues with them"
            )


Goal = Decommission | Rollback


def _book(
    goal_of: Callable[[Reader, State], Goal], told: Callable[[ClaimChange], str], options: Options
) -> tuple[Json, Sequence[ClaimChange], list[str]]:
    """Book a goal through the journal like a demand, so that others may write meanwhile.

    ``told`` returns a line about a changed claim. Return the JSON, the changes, and lines about
    what followed, or would follow.
    """
    with reader.opened(options.state_repo, only_read=options.dry_run) as repo:
        with busy("reading the ledger") as report:
            state = repo.snapshot(progress=report).state
        goal = goal_of(repo, state)
        request = restoration(repo.objects, goal) if isinstance(goal, Rollback) else goal
        data: Json = {"outcome": "unchanged", "commit": None, "releases": []}
        try:
            decision = decide(state, request, REAL.now(), repo.file_reader())
        except Refused as error:
            # a node that holds nothing is no error; any other name that does may be misspelled
            is_node = isinstance(goal, Decommission) and "node" in goal.kinds
            is_known = is_node and goal.id in state.config.nodes
            if not is_known or {fault.code for fault in error.faults} != {"not-held"}:
                raise
            return data, (), []
    changes, releases = decision.changes.claims, [asdict(each) for each in decision.releases]
    data |= {"outcome": decision.outcome, "releases": releases}
    lines = [*(f"would be {told(change)}" for change in changes), *consequence_of([decision])]
    lines = [fitted(line, terminal_width()) for line in lines]
    if options.dry_run:
        return data, changes, lines
    if decision.outcome != "unchanged":
        for line in lines if options.output == "text" and not options.yes else ():
            errors.print(line)
        confirm("Continue?", options.yes)
    warned_if_unnamed(commit_log.operator())
    with started_generator(options.state_repo, options.signing_key) as generator:
        ticket = generator.submit(goal)
        with busy("booking"):
            await_answer(ticket.future)
        receipt = ticket.future.result()
    done.append(f"{receipt.outcome} in {receipt.commit}")
    data |= {"outcome": receipt.outcome, "commit": receipt.commit}
    return data, receipt.changes, [*map(told, receipt.changes)]


def consequence_of(decisions: Collection[Decision]) -> Iterator[str]:
    changes = [change for decision in decisions for change in decision.changes.claims]
    less = [change.before for change in changes if change.before and change.only_narrows]
    who = {name for claim in less for name in claim.requesters}
    return consequence([each for made in decisions for each in made.releases], who, less)


def claim_text(change: ClaimChange) -> str:
    claim = change.before or change.after
    assert claim is not None  # noqa: S101 - a change has at least one side
    return f"{claim.subject} for {', '.join(claim.requesters)}"


# ---- ``demandops release`` and ``decommission``: end all claims of something ----


def _end(name: str, kinds: Sequence[str], options: Options) -> None:
    ended, before = name, list[Claim]()
    is_release = "demand" in kinds or "application" in kinds

    def goal_of(repo: Reader, state: State) -> Goal:
        nonlocal ended
        ended = _meant(name, kinds, state)
        before.extend(state.ledger)
        by = str(repo.operator())
        return goals.decommission(ended, frozenset(kinds), by, options.reason)

    def told(change: ClaimChange) -> str:
        left = f"; kept for {', '.join(change.after.requesters)}" if change.after else ""
        return f"{'reduced: ' if left else 'released:'} {claim_text(change)}{left}"

    data, changes, lines = _book(goal_of, told, options)
    data["claims"] = [
        claim_data(change.before)
        | {"left": list(change.after.requesters) if change.after else None}
        for change in changes
        if change.before
    ]
    if data["outcome"] == "unchanged":
        lines = [f"'{ended}' holds nothing"]
    elif data["commit"]:
        word = "released" if is_release else "decommissioned"
        lines.append(f"'{ended}' is {word} in {data['commit']}")
        if is_release:
            again = "if it is demanded again, it runs again; `demandops suspend` prevents that"
            lines.append(again)
    # of an application the claims end, and what else their demands list stays
    demands, keys = {change.key.demand for change in changes}, {change.key for change in changes}
    kept = sorted({str(c.subject) for c in before if c.demand in demands and c.key not in keys})
    if is_release and kept:
        ways = (shlex.join(["demandops", "release", demand]) for demand in sorted(demands))
        lines += [f"what these demands list besides stays: {', '.join(kept)}", "to end that too:"]
        lines += [f"  {way}" for way in ways]
    show(options.output, {"name": ended, **data}, lines)


def _meant(name: str, kinds: Iterable[str], state: State, earlier: State | None = None) -> str:
    """Return the name; that of a demand may be its start, or the id of its request.

    A demand of an ``earlier`` state may have ended meanwhile.
    """
    ledger = state.ledger
    claims: list[Claim] = [*ledger, *(earlier.ledger if earlier else ())]
    known: dict[str, Iterable[str]] = {
        "node": {*state.config.nodes},
        "requester": ledger.indexed_names("requester"),
        "demand": {claim.demand for claim in claims} | {*ledger.waiting},
        "application": {*ledger.subjects(SubjectKind.APPLICATION)},
    }
    if any(name in known[kind] for kind in kinds):
        return name
    if "demand" in kinds:
        of_request = {claim.demand for claim in claims if claim.request == name}
        starting = of_request or {id for id in known["demand"] if name and id.startswith(name)}
        if len(starting) == 1:
            return min(starting)
        if starting:
            message = f"'{name}' fits several demands: {', '.join(sorted(starting)[:5])}; name one"
            raise InvalidInput.at("", message)
    for kind, names in known.items():
        if name in names:
            verb = "decommission" if kind in ("node", "requester") else "release"
            run = f"run: demandops {verb} {shlex.quote(name)}"
            demands = sorted({claim.demand for claim in ledger if name in claim.requesters})
            if verb == "decommission" and demands:
                listed = fitted(", ".join(demands), 200)
                run = f"to stop one demand, name it: {listed}; to release all that it holds, {run}"
            article = "an" if kind == "application" else "a"
            raise InvalidInput.at("", f"'{name}' is {article} {kind}; {run}")
    return name


def _only(kind: str, other: str) -> Callable[..., Any]:
    return click.option(
        f"--{kind}",
        "kind",
        flag_value=kind,
        help=f"The name is that of the {kind}, not of the {other}.",
    )


@click.command()
@click.argument("name", metavar="DEMAND|APPLICATION", shell_complete=names_of("demands"))
@_only("demand", "application")
@_only("application", "demand")
@changing()
def release(name: str, kind: str | None, options: Options) -> None:
    """DEMAND is the id of a demand or of its request, or the start of a demand's id: all its claims
    are released, also if it waits for room. Of an APPLICATION, the claims of all demands are
    released; what else these demands hold stays. What others need runs on. Whoever demands it again
    gets it again: to keep it from running, see `demandops suspend`.

    \b
    Examples:
      demandops release visit -m "The visit is over"
      demandops release edge/object_detection_fusion --dry-run
    """
    _end(name, [kind] if kind else ["demand", "application"], options)


@click.command()
@click.argument("name", metavar="NODE|REQUESTER", shell_complete=names_of("nodes", "requesters"))
@_only("node", "requester")
@_only("requester", "node")
@changing()
def decommission(name: str, kind: str | None, options: Options) -> None:
    """For a node, the command releases the applications on the node, the inputs that come from the
    node, the deliveries to the node, and the connections from and to the node, for every requester.
    Then you can delete the node from the inventory. For a requester, the command releases all
    claims of this requester, even claims that also name other requesters. It also ends the waiting
    demands that name only this requester. If NAME is both a node and a requester, the command does
    both.

    \b
    Examples:
      demandops decommission vehicle00 --dry-run
      demandops decommission vehicle00 -m "Sold" --yes
      demandops decommission edge --node
    """
    _end(name, [kind] if kind else ["node", "requester"], options)


# ---- ``demandops rollback``: restore the ledger of an earlier commit ----

# How many newer commits of people are named, which a rollback leaves.
_MOST_EDITS = 5


@click.command()
@click.argument("revision", metavar="[REV|TIME]", default="", required=False)
@name_options(
    {
        "demand": "Roll back only this demand.",
        "application": "Roll back only this application, with the connections of its demands.",
    },
    metavar="ID",
    default="",
)
@click.option(
    "--drop-newer",
    is_flag=True,
    help="Also undo claims that were booked or changed after REV or TIME. Without it, such claims "
    "prevent the rollback.",
)
@changing()
def rollback(
    revision: str, demand: str, application: str, drop_newer: bool, options: Options
) -> None:
    """Claims that were released after the earlier commit are booked again, with the current
    configuration. Claims that were booked or changed after it prevent the rollback, unless you give
    --drop-newer. The lease of a restored claim starts again with its full term. REV is a commit.
    TIME selects the newest commit at or before this time. Without both, --demand or --application
    means the commit before its last change.

    \b
    Examples:
      demandops rollback 14:00 --dry-run
      demandops rollback 14:00 -m "The station sent nonsense"
      demandops rollback 2h -m "A wrong test" --demand visit
      demandops rollback --application edge/object_detection_fusion -m "A mistake"
      demandops rollback 2h -m "A wrong test" --drop-newer --yes
    """
    if demand and application:
        raise click.UsageError("give --demand or --application, not both")
    if not options.dry_run:
        options = options.with_reason()
    if not (revision or demand or application):
        raise click.UsageError("give REV or TIME, or --demand or --application")
    to, since, edits = "", list[str](), list[str]()

    def goal_of(repo: Reader, state: State) -> Goal:
        nonlocal to, since, edits
        about = (
            each.commit
            for each in repo.log()
            if application in each.trailers.get("Application", ())
            or (demand and any(id.startswith(demand) for id in each.trailers.get("Demand-Id", ())))
        )
        try:
            to = resolved(repo, revision or f"{next(about, MAIN_BRANCH)}~1")
        except StateRepoError as error:
            hint = options_for(repo, revision, ("demand", "application"))
            raise StateRepoError(f"{error}{hint}") from None
        since = repo.changed_files(to, repo.commit(), CONFIG_ROOTS)
        people = (each.commit for each in repo.log(f"{to}..") if since and not each.by_generator)
        edits = [each for each in people if not {*since}.isdisjoint(repo.files_changed_by(each))]
        only = {"application": application} if application else {}
        if demand:
            only["demand"] = _meant(demand, ["demand"], state, repo.snapshot(to).state)
        who = repo.operator()
        return goals.rollback(to, drop_newer=drop_newer, reason=options.reason, who=who, **only)

    def way(change: ClaimChange) -> str:
        if change.after is None:
            return "dropped"
        return "changed back" if change.before else "restored"

    data, changes, lines = _book(
        goal_of, lambda change: f"{way(change)}: {claim_text(change)}", options
    )
    for each in ("restored", "changed back", "dropped"):
        of_way = (change.after or change.before for change in changes if way(change) == each)
        data[each.replace(" ", "_")] = [claim_data(claim) for claim in of_way if claim]
    if data["outcome"] == "unchanged":
        lines = [f"the ledger is the same as at {to[:10]}; there is nothing to roll back"]
    elif data["commit"]:
        lines.append(f"rolled back to {to[:10]} in {data['commit']}")
    if since:
        lines.append(
            "a rollback does not change the configuration, so these configuration files stay "
            f"different from those at {to[:10]}:"
        )
        lines += [f"  {path}" for path in since]
        lines += [f"to undo that: demandops revert {edit[:10]}" for edit in edits[:_MOST_EDITS]]
    show(options.output, {"to": to, **data, "configuration_since": since}, lines)
