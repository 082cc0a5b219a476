"""``demandops rollback``: restore the ledger of an earlier commit, by a new commit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from demandops.cli.actions.ledger_change import fault_lines, started_generator
from demandops.cli.json_output import (
    claim_data,
    faults_of,
    output_option,
    print_json,
    release_change_data,
)
from demandops.cli.output import (
    SIGNS,
    console,
    errors,
    progress,
    signing_option,
    state_repo_option,
)
from demandops.decision import Decision, decide
from demandops.errors import InvalidInput
from demandops.runtime import REAL
from demandops.service import rollback_goal as rollbacks
from demandops.staterepo import reader
from demandops.staterepo.history.authorship import Person
from demandops.staterepo.reader import Reader

_SIGN = {"restored": "+", "changed_back": "~", "dropped": "-"}


@dataclass(frozen=True, slots=True)
class _Target:
    """The commit to roll back to, and the options."""

    to: str
    drop_newer: bool
    reason: str
    person: Person


@click.command()
@click.argument("revision", metavar="REV|TIME")
@state_repo_option
@click.option("-m", "--reason", metavar="TEXT", help="The reason, for the commit message.")
@click.option(
    "--drop-newer",
    is_flag=True,
    help="Also drop claims that were booked since then; otherwise they prevent the rollback.",
)
@click.option("--dry-run", is_flag=True, help="Show the consequences and change nothing.")
@signing_option
@output_option
@click.pass_context
def rollback(  # noqa: PLR0913, PLR0917 - one for each option
    ctx: click.Context,
    revision: str,
    state_repo: str,
    reason: str | None,
    drop_newer: bool,
    dry_run: bool,
    signing_key: Path | None,
    output: str,
) -> None:
    """Restore the ledger of an earlier commit, by a new commit.

    Claims that were released since then are booked again, with the current configuration. A lease
    starts again with its full term. REV is a commit; TIME means the newest commit at or before it.
    """
    if not (dry_run or (reason and reason.strip())):
        raise click.UsageError("give the reason: -m TEXT")
    with reader.opened(state_repo) as repo:
        target = _Target(repo.commit(revision), drop_newer, reason or "", repo.operator())
        base = repo.commit()
        result: dict[str, Any] = {"to": target.to, "outcome": "refused", "commit": None}
        result |= _consequences(None)
        result |= {"configuration_since": repo.config_files_changed_since(target.to), "faults": []}
        try:
            result |= _dry_run(repo, target, base)
        except InvalidInput as error:
            result["faults"] = faults_of(error)
    if not dry_run and not result["faults"]:
        result |= _roll_back(state_repo, target, signing_key, base)
    if output == "json":
        print_json(result)
    else:
        _print(result, dry_run)
    if result["faults"]:
        ctx.exit(1)


def _dry_run(repo: Reader, target: _Target, base: str) -> dict[str, Any]:
    """Decide the rollback on a commit, in memory only."""
    with progress("reading the ledger") as report:
        state = repo.last_valid_snapshot(base, report).state
    request = repo.restoration(target.to, drop_newer=target.drop_newer)
    decision = decide(state, request, REAL.now(), repo.file_reader(base))
    return {"outcome": decision.outcome, **_consequences(decision)}


def _consequences(decision: Decision | None) -> dict[str, Any]:
    claims: dict[str, list[dict[str, Any]]] = {word: [] for word in _SIGN}
    for change in decision.changes.claims if decision else ():
        word = "changed_back" if change.before else "restored"
        claim = change.after or change.before
        assert claim is not None  # noqa: S101 - a change has at least one side
        claims[word if change.after else "dropped"].append(claim_data(claim))
    releases = decision.releases if decision else ()
    return {**claims, "releases": [release_change_data(each) for each in releases]}


def _roll_back(state_repo: str, target: _Target, key: Path | None, base: str) -> dict[str, Any]:
    """Roll back with a generator; return the result."""
    goal = rollbacks.goal(
        target.to, drop_newer=target.drop_newer, reason=target.reason, who=target.person
    )
    try:
        with started_generator(state_repo, key) as generator:
            receipt = generator.submit(goal).future.result()
    except InvalidInput as error:
        return {"outcome": "refused", **_consequences(None), "faults": faults_of(error)}
    result: dict[str, Any] = {"outcome": receipt.outcome, "commit": receipt.commit}
    if receipt.outcome == "unchanged":
        return result | _consequences(None)
    with reader.opened(state_repo) as repo:
        decided_on = repo.commit(f"{receipt.commit}~1")
        if decided_on != base:  # the tip moved in between
            result |= _dry_run(repo, target, decided_on)
    return result


def _print(result: dict[str, Any], dry_run: bool) -> None:
    to, out = result["to"][:10], console()
    if result["faults"]:
        errors.print(f"the rollback to {to} is refused:")
        for line in fault_lines(result["faults"]):
            errors.print(line)
    elif result["outcome"] == "unchanged":
        out.print(f"the ledger is the same as at {to}; there is nothing to roll back")
    elif dry_run:
        out.print(f"the rollback to {to} would change:")
    else:
        out.print(f"rolled back to {to} in {result['commit']}")
    for word, sign in _SIGN.items():
        for claim in result[word]:
            who = ", ".join(claim["requesters"])
            subject = f"{claim['subject']['kind']} '{claim['subject']['id']}'"
            out.print(f"  {sign} claim of {who} on {subject} ({word.replace('_', ' ')})")
    for release in result["releases"]:
        out.print(f"  {SIGNS[release['change']]} release {release['name']} ({release['what']})")
        for detail in release["details"]:
            out.print(f"      {detail}")
    since = result["configuration_since"]
    if since:
        out.print(f"a rollback does not change configuration; changed since {to}:")
        for path in since:
            out.print(f"  {path}")
