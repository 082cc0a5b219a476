"""``demandops rollback``: restore the ledger of an earlier commit, by a new commit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import click

from demandops.cli.actions.ledger_change import (
    booked,
    claim_text,
    print_refusal,
    started_generator,
)
from demandops.cli.actions.person_change import (
    confirm,
    is_asked,
    reason_option,
    warned_if_unnamed,
    yes_option,
)
from demandops.cli.json_output import Json, claim_data, faults_of, output_option, show
from demandops.cli.output import progress
from demandops.cli.target import dry_run_option, signing_option, writable_repo_option
from demandops.cli.views.diff import release_lines
from demandops.config.config import CONFIG_ROOTS
from demandops.decision import Decision, decide
from demandops.errors import InvalidInput
from demandops.render.changes.changeset import ReleaseChange
from demandops.runtime import REAL
from demandops.service import rollback_goal
from demandops.staterepo import reader
from demandops.staterepo.reader import Reader

_SIGN = {"restored": "+", "changed_back": "~", "dropped": "-"}


@click.command()
@click.argument("revision", metavar="REV|TIME")
@writable_repo_option
@reason_option
@click.option(
    "--drop-newer",
    is_flag=True,
    help="Also undo claims that were booked or changed after REV or TIME. Without it, such claims "
    "prevent the rollback.",
)
@dry_run_option
@yes_option
@signing_option
@output_option
def rollback(  # noqa: PLR0913, PLR0917 - each is an option
    revision: str,
    state_repo: str,
    reason: str | None,
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
    if not (dry_run or (reason and reason.strip())):
        raise click.UsageError("give the reason: -m TEXT")
    with reader.opened(state_repo, only_read=dry_run) as repo:
        to, base = repo.commit(revision), repo.commit()
        who = repo.operator() if dry_run else warned_if_unnamed(repo.operator())
        goal = rollback_goal.goal(to, drop_newer=drop_newer, reason=reason or "", who=who)
        result: Json = {"to": to, "outcome": "refused", "commit": None}
        since = repo.changed_files(to, base, CONFIG_ROOTS)
        result |= {**_consequences(None), "configuration_since": since, "faults": []}
        try:
            result |= _dry_run(repo, goal, base)
        except InvalidInput as error:
            result["faults"] = faults_of(error)
    if not dry_run and not result["faults"]:
        if is_asked(yes, output) and result["outcome"] != "unchanged":
            show(output, None, _lines(result, True))
            confirm("Continue?", yes, output)
        result |= _roll_back(state_repo, goal, signing_key, base)
    if result["faults"] and output == "text":
        print_refusal(f"the rollback to {to[:10]} is refused:", result["faults"])
    show(output, result, _lines(result, dry_run))
    if result["faults"]:
        raise click.exceptions.Exit(1)


def _dry_run(repo: Reader, goal: Json, base: str) -> Json:
    """Return the outcome and consequences of a rollback on top of ``base``; book nothing."""
    with progress("reading the ledger") as report:
        state = repo.last_valid_snapshot(base, report).state
    request = repo.restoration(goal["to"], drop_newer=goal["dropNewer"])
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
    return {**claims, "releases": [asdict(each) for each in releases]}


def _roll_back(state_repo: str, goal: Json, signing_key: Path | None, base: str) -> Json:
    """Roll back with a generator; return the outcome as JSON data.

    The caller knows the consequences on top of the commit ``base``. The data has others if the
    rollback was decided on another commit, was refused or had no effect.
    """
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
            result |= _dry_run(repo, goal, decided_on)
    return result


def _lines(result: Json, dry_run: bool) -> Iterator[str]:
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
    releases = (ReleaseChange(**each) for each in result["releases"])
    yield from (f"  {line}" for line in release_lines(releases, "release "))
    if result["configuration_since"]:
        yield (
            "a rollback does not change the configuration, so these configuration files stay "
            f"different from those at {to}:"
        )
        yield from (f"  {path}" for path in result["configuration_since"])
