"""Commands that change the ledger: what they share, ``decommission`` and ``rollback``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from demandops.base.errors import Fault, InvalidInput, Refused
from demandops.base.runtime import REAL
from demandops.cli.changes import person_change
from demandops.cli.json_output import faults_of, output_option, show
from demandops.cli.output import busy, console, done, errors, progress
from demandops.cli.queries.diff import release_lines
from demandops.cli.target import dry_run_option, names_of, signing_option, writable_repo_option
from demandops.decide.changeset import ReleaseChange
from demandops.decide.decision import Decision, decide
from demandops.model.config.config import CONFIG_ROOTS
from demandops.model.demand import goals
from demandops.model.demand.demand import Decommission, Demand, Rollback
from demandops.model.ledger.ledger import ClaimChange
from demandops.repo import reader
from demandops.repo.history import commit_log
from demandops.repo.load.snapshot import Snapshot
from demandops.repo.reader import Reader
from demandops.serve.generator import Generator
from demandops.serve.journal import Receipt
from demandops.views.vocabulary import Json, claim_data

# ---- booking, and printing the changes ----

# A person who waits at a terminal is told soon that the server refuses every commit.
_REFUSAL_PATIENCE_S = 4.0


def await_answer(future: Future[Any]) -> None:
    # Polled, so that Ctrl-C and SIGTERM interrupt it: a wait without a timeout could miss a signal
    # that arrives just before the wait begins, or a signal that another library handles.
    while not future.done():
        wait([future], timeout=0.5)


def booked(generator: Generator, demand: Demand) -> Receipt:
    ticket = generator.submit(demand)
    with busy("booking"):
        await_answer(ticket.future)
    receipt = ticket.future.result()
    done.append(f"{receipt.outcome} in {receipt.commit}")
    return receipt


@contextmanager
def started_generator(state_repo: str, signing_key: Path | None) -> Iterator[Generator]:
    with progress("reading the ledger") as report:
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


def print_consequences(decision: Decision) -> None:
    out = console()
    for line in release_lines(decision.releases):
        out.print(f"  {line}", soft_wrap=True)
    for path, text in sorted(decision.files.items()):
        out.print(f"  {'remove' if text is None else 'write '} {path}", soft_wrap=True)


def print_refusal(title: str, faults: Iterable[Json]) -> None:
    errors.print(title)
    for fault in faults:
        errors.print(f"  {Fault(**fault)}")


def claim_text(claim: Json) -> str:
    return f"{claim['subject']['kind']} '{claim['subject']['id']}'"


# ---- ``demandops decommission``: release all claims of a node or a requester ----


@click.command()
@click.argument("name", metavar="NODE|REQUESTER", shell_complete=names_of("nodes", "requesters"))
@writable_repo_option
@click.option(
    "--node",
    "kinds",
    flag_value="node",
    help="Decommission only the node NAME, not a requester of the same name.",
)
@click.option(
    "--requester",
    "kinds",
    flag_value="requester",
    help="Decommission only the requester NAME, not a node of the same name.",
)
@person_change.reason_option
@dry_run_option
@person_change.yes_option
@signing_option
@output_option
def decommission(  # noqa: PLR0913, PLR0917 - each is an option
    name: str,
    state_repo: str,
    kinds: str | None,
    reason: str,
    dry_run: bool,
    yes: bool,
    signing_key: Path | None,
    output: str,
) -> None:
    """Release all claims of a node or a requester.

    For a node, the command releases the applications on the node, the inputs that come from the
    node, the deliveries to the node, and the connections from and to the node, for every requester.
    Then you can delete the node from the inventory. For a requester, the command releases all
    claims of this requester, even claims that also name other requesters. It also ends the waiting
    demands that name only this requester. If NAME is both a node and a requester, the command does
    both. At a terminal, the command first shows the consequences and asks.

    \b
    Examples:
      demandops decommission vehicle00 --dry-run
      demandops decommission vehicle00 -m "Sold" --yes
      demandops decommission edge --node
    """
    chosen = frozenset([kinds] if kinds else ["node", "requester"])
    by = commit_log.operator()
    goal = goals.decommission(name, chosen, str(by), reason)
    if dry_run or person_change.is_asked(yes, output):
        row = _dry_run_decommission(goal, state_repo, output)
        show(output, row, _decommission_lines(row, True))
        if dry_run or row["outcome"] == "unchanged":
            return
        person_change.confirm("Continue?", yes, output)
    # booked by a generator through the journal, like a demand, so others may run meanwhile
    with started_generator(state_repo, signing_key) as generator:
        person_change.warned_if_unnamed(by)
        try:
            receipt = booked(generator, goal)
            row = _row(goal, receipt.outcome, receipt.commit, receipt.changes)
        except Refused as error:
            if not _is_unclaimed_node(error, goal, generator.snapshot):
                raise
            row = _row(goal, "unchanged", None, ())
    show(output, row, _decommission_lines(row, False))


def _dry_run_decommission(goal: Decommission, state_repo: str, output: str) -> Json:
    with reader.opened(state_repo) as repo, progress("reading the ledger") as report:
        snapshot = repo.snapshot(progress=report)
        try:
            decision = decide(snapshot.state, goal, REAL.now(), repo.file_reader())
        except Refused as error:
            if not _is_unclaimed_node(error, goal, snapshot):
                raise
            return _row(goal, "unchanged", None, ())
    if output == "text":
        print_consequences(decision)
    return _row(goal, decision.outcome, None, decision.changes.claims)


def _is_unclaimed_node(error: Refused, goal: Decommission, snapshot: Snapshot) -> bool:
    # a node that holds nothing is no error; any other name that holds nothing may be misspelled
    codes = {fault.code for fault in error.faults}
    return codes == {"not-held"} and goal.id in snapshot.state.config.nodes


def _row(
    goal: Decommission, outcome: str, commit: str | None, changes: Iterable[ClaimChange]
) -> Json:
    claims = [
        claim_data(change.before)
        | {"left": list(change.after.requesters) if change.after else None}
        for change in changes
        if change.before
    ]
    return {"name": goal.id, "outcome": outcome, "commit": commit, "claims": claims}


def _decommission_lines(row: Json, dry_run: bool) -> Iterator[str]:
    if row["outcome"] == "unchanged":
        yield f"'{row['name']}' holds nothing"
        return
    would = "would be " if dry_run else ""
    for claim in row["claims"]:
        text = f"{claim_text(claim)} for {', '.join(claim['requesters'])}"
        if claim["left"] is None:
            yield f"{would}released: {text}"
        else:
            yield f"{would}reduced:  {text}; kept for {', '.join(claim['left'])}"
    if not dry_run:
        yield f"'{row['name']}' is decommissioned in {row['commit']}"


# ---- ``demandops rollback``: restore the ledger of an earlier commit ----

_SIGN = {"restored": "+", "changed_back": "~", "dropped": "-"}


@click.command()
@click.argument("revision", metavar="REV|TIME")
@writable_repo_option
@person_change.reason_option
@click.option(
    "--drop-newer",
    is_flag=True,
    help="Also undo claims that were booked or changed after REV or TIME. Without it, such claims "
    "prevent the rollback.",
)
@dry_run_option
@person_change.yes_option
@signing_option
@output_option
def rollback(  # noqa: PLR0913, PLR0917 - each is an option
    revision: str,
    state_repo: str,
    reason: str,
    drop_newer: bool,
    dry_run: bool,
    yes: bool,
    signing_key: Path | None,
    output: str,
) -> None:
    """Restore the claims of an earlier commit, by a new commit.

    Claims that were released after the earlier commit are booked again, with the current
    configuration. Claims that were booked or changed after it prevent the rollback, unless
    you give --drop-newer. The lease of a restored claim starts again with its full term. REV is a
    commit. TIME selects the newest commit at or before this time. At a terminal, the command first
    shows the consequences and asks.

    \b
    Examples:
      demandops rollback 14:00 --dry-run
      demandops rollback 14:00 -m "The station sent nonsense"
      demandops rollback 2h -m "A wrong test" --drop-newer --yes
    """
    if not (dry_run or reason):
        raise click.UsageError("give the reason: -m TEXT")
    with reader.opened(state_repo, only_read=dry_run) as repo:
        to, base = repo.commit(revision), repo.commit()
        who = repo.operator() if dry_run else person_change.warned_if_unnamed(repo.operator())
        goal = goals.rollback(to, drop_newer=drop_newer, reason=reason, who=who)
        result: Json = {"to": to, "outcome": "refused", "commit": None}
        since = repo.changed_files(to, base, CONFIG_ROOTS)
        result |= {**_consequences(None), "configuration_since": since, "faults": []}
        try:
            result |= _dry_run_rollback(repo, goal, base)
        except InvalidInput as error:
            result["faults"] = faults_of(error)
    if not dry_run and not result["faults"]:
        if person_change.is_asked(yes, output) and result["outcome"] != "unchanged":
            show(output, None, _rollback_lines(result, True))
            person_change.confirm("Continue?", yes, output)
        result |= _roll_back(state_repo, goal, signing_key, base)
    if result["faults"] and output == "text":
        print_refusal(f"the rollback to {to[:10]} is refused:", result["faults"])
    show(output, result, _rollback_lines(result, dry_run))
    if result["faults"]:
        raise click.exceptions.Exit(1)


def _dry_run_rollback(repo: Reader, goal: Rollback, base: str) -> Json:
    with progress("reading the ledger") as report:
        state = repo.snapshot(base, report).state
    request = repo.restoration(goal)
    decision = decide(state, request, REAL.now(), repo.file_reader(base))
    return {"outcome": decision.outcome, **_consequences(decision)}


def _consequences(decision: Decision | None) -> Json:
    claims: dict[str, list[Json]] = {word: [] for word in _SIGN}
    for change in decision.changes.claims if decision else ():
        word = "changed_back" if change.before else "restored"
        claim = change.after or change.before
        assert claim is not None  # noqa: S101 - a change has at least one side
        claims[word if change.after else "dropped"].append(claim_data(claim))
    releases = decision.releases if decision else ()
    return {**claims, "releases": [asdict(release) for release in releases]}


def _roll_back(state_repo: str, goal: Rollback, signing_key: Path | None, base: str) -> Json:
    """Return the outcome, and the consequences if they are not those on ``base``."""
    try:
        with started_generator(state_repo, signing_key) as generator:
            receipt = booked(generator, goal)
    except InvalidInput as error:
        return {"outcome": "refused", **_consequences(None), "faults": faults_of(error)}
    result: Json = {"outcome": receipt.outcome, "commit": receipt.commit}
    if receipt.outcome == "unchanged":
        return result | _consequences(None)
    with reader.opened(state_repo) as repo:
        decided_on = repo.commit(f"{receipt.commit}~1")
        if decided_on != base:  # main has moved since the consequences were shown
            result |= _dry_run_rollback(repo, goal, decided_on)
    return result


def _rollback_lines(result: Json, dry_run: bool) -> Iterator[str]:
    to = result["to"][:10]
    if result["outcome"] == "unchanged":
        yield f"the ledger is the same as at {to}; there is nothing to roll back"
    elif not result["faults"]:
        done = f"rolled back to {to} in {result['commit']}"
        yield f"the rollback to {to} would change:" if dry_run else done
    for word, sign in _SIGN.items():
        for claim in result[word]:
            what = f"claim of {', '.join(claim['requesters'])} on {claim_text(claim)}"
            yield f"  {sign} {what} ({word.replace('_', ' ')})"
    releases = (ReleaseChange(**release) for release in result["releases"])
    yield from (f"  {line}" for line in release_lines(releases, "release "))
    if result["configuration_since"]:
        yield (
            "a rollback does not change the configuration, so these configuration files stay "
            f"different from those at {to}:"
        )
        yield from (f"  {path}" for path in result["configuration_since"])
