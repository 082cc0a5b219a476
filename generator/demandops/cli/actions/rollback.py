"""``demandops rollback``: back to the books of an earlier commit, by a new one."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import click

from demandops.cli.output import (
    SIGNS,
    console,
    errors,
    output_option,
    print_json,
    progress,
    signing_option,
    state_repo_option,
)
from demandops.decision import Decision, decide
from demandops.errors import InvalidInput
from demandops.ledger import claim_file as ledger_format
from demandops.service import Generator
from demandops.service import rollback_goal as rollbacks
from demandops.staterepo import reader
from demandops.staterepo.reader import Reader

_SIGN = {"restored": "+", "changed_back": "~", "dropped": "-"}


@dataclass(frozen=True, slots=True)
class _Wish:
    """What was asked for: the commit to go back to, and how."""

    to: str
    drop_newer: bool
    reason: str
    who: tuple[str, str]


@click.command()
@click.argument("revision", metavar="REV|TIME")
@state_repo_option
@click.option("-m", "--reason", metavar="TEXT", help="Why; it stands in the commit.")
@click.option(
    "--drop-newer",
    is_flag=True,
    help="Drop what was booked since; without it such a rollback is refused.",
)
@click.option("--dry-run", is_flag=True, help="Show the consequence and change nothing.")
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
    """Go back to the books of an earlier commit, by a new commit.

    Claims that were released since come back and what they ask for runs again, with today's
    configuration: that is people's, and stays. A claim with a lease gets its full term again. REV
    is a commit; a TIME stands for the newest commit at or before it.
    """
    if not (dry_run or (reason and reason.strip())):
        raise click.UsageError("say why: -m REASON")
    with reader.opened(state_repo) as repo:
        wish = _Wish(repo.commit(revision), drop_newer, reason or "", repo.person())
        base = repo.commit()
        found: dict[str, Any] = {"to": wish.to, "outcome": "refused", "commit": None}
        found |= _consequence(None)
        found |= {"configuration_since": repo.configured_since(wish.to), "errors": []}
        try:
            found |= _rehearsed(repo, wish, base)
        except InvalidInput as error:
            found["errors"] = _errors(error)
    if not dry_run and not found["errors"]:
        found |= _done(state_repo, wish, signing_key, base)
    if output == "json":
        print_json(found)
    else:
        _print(found, dry_run)
    if found["errors"]:
        ctx.exit(1)


def _rehearsed(repo: Reader, wish: _Wish, base: str) -> dict[str, Any]:
    """Decide the rollback on top of a commit, in memory only."""
    with progress("reading the ledger") as tell:
        state = repo.last_valid(base, tell).state
    request = repo.restoration(wish.to, drop_newer=wish.drop_newer)
    decision = decide(state, request, datetime.now(timezone.utc), repo.file_reader(base))
    return {"outcome": decision.outcome, **_consequence(decision)}


def _consequence(decision: Decision | None) -> dict[str, Any]:
    claims: dict[str, list[dict[str, Any]]] = {word: [] for word in _SIGN}
    for change in decision.changes.claims if decision else ():
        word = "changed_back" if change.before else "restored"
        claim = change.after or change.before
        assert claim is not None  # noqa: S101 - a change has at least one side
        claims[word if change.after else "dropped"].append(
            {
                "subject": str(claim.subject),
                "demand": claim.demand,
                "request": claim.request,
                "requesters": list(claim.requesters),
                "file": ledger_format.path_of(claim.key),
            }
        )
    releases = [
        {"name": one.name, "change": one.change, "what": one.what, "details": list(one.details)}
        for one in (decision.releases if decision else ())
    ]
    return {**claims, "releases": releases}


def _done(state_repo: str, wish: _Wish, key: Path | None, base: str) -> dict[str, Any]:
    """Have a generator roll back; tell what it came to, on whatever it was judged."""
    with progress("reading the ledger") as tell:
        generator = Generator(state_repo, start_offline=False, signing_key=key, progress=tell)
    try:
        goal = rollbacks.goal(wish.to, drop_newer=wish.drop_newer, reason=wish.reason, who=wish.who)
        receipt = generator.submit(goal).future.result()
    except InvalidInput as error:
        return {"outcome": "refused", **_consequence(None), "errors": _errors(error)}
    finally:
        generator.close(timeout=0)
    found: dict[str, Any] = {"outcome": receipt.outcome, "commit": receipt.commit}
    if receipt.outcome == "unchanged":
        return found | _consequence(None)
    with reader.opened(state_repo) as repo:
        judged_on = repo.commit(f"{receipt.commit}~1")
        if judged_on != base:  # others wrote meanwhile, or people's changes were taken in before
            found |= _rehearsed(repo, wish, judged_on)
    return found


def _errors(error: InvalidInput) -> list[dict[str, str]]:
    return [{"file": one.file, "field": one.field, "message": one.message} for one in error.faults]


def _print(found: dict[str, Any], dry_run: bool) -> None:
    to, out = found["to"][:10], console()
    if found["errors"]:
        errors.print(f"the rollback to {to} is refused:")
        for one in found["errors"]:
            where = [part for part in (one["file"], one["field"]) if part]
            errors.print(f"  {': '.join([*where, one['message']])}")
    elif found["outcome"] == "unchanged":
        out.print(f"the books are what they were at {to}; nothing to roll back")
    elif dry_run:
        out.print(f"the rollback to {to} would change:")
    else:
        out.print(f"rolled back to {to} in {found['commit']}")
    for word, sign in _SIGN.items():
        for claim in found[word]:
            who = ", ".join(claim["requesters"])
            out.print(f"  {sign} claim of {who} on {claim['subject']} ({word.replace('_', ' ')})")
    for release in found["releases"]:
        out.print(f"  {SIGNS[release['change']]} release {release['name']} ({release['what']})")
        for detail in release["details"]:
            out.print(f"      {detail}")
    since = found["configuration_since"]
    if since:
        out.print(f"configuration is people's and stays as it is; changed since {to}:")
        for path in since:
            out.print(f"  {path}")
