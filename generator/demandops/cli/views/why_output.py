"""The answers of ``demandops why``, as plain data and as lines."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from demandops.cli.json_output import (
    claim_data,
    commit_data,
    override_data,
    place_data,
    release_data,
    subject_data,
    time_text,
)
from demandops.config.override import Override
from demandops.demand.claim import Claim
from demandops.ledger.world import World
from demandops.plan.overrides.claim_overrides import suspended_by, without_suspended
from demandops.plan.release import Release
from demandops.plan.views import release_causes
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader
from demandops.subject import Subject

_MOST_CARRIED_OUT = 5


def release(snapshot: Snapshot, running: Release) -> dict[str, Any]:
    """Return why a release runs."""
    world = snapshot.state
    claims = release_causes.claims_behind(without_suspended(world).ledger, running)
    return {
        "runs": True,
        **place_data(running),
        "requesters": sorted({who for claim in claims for who in claim.requesters}),
        "claims": [_claim(claim, world) for claim in claims],
        "shaped_by": [
            {"file": file, "entry": entry or None, "what": what}
            for file, entry, what in release_causes.shaping_files(running, world.config)
        ],
        "overrides": [override_data(*each) for each in running.shaping.by],
    }


def denied(stopped: Release, by: Override) -> dict[str, Any]:
    """Return why a release does not run although claims request it."""
    return {
        "runs": False,
        **place_data(stopped),
        "denied_by": override_data(by, ("deny",)),
    }


def subject(snapshot: Snapshot, claimed: Subject) -> dict[str, Any]:
    """Return the claims on an application or a connection, and the releases that it needs."""
    world = snapshot.state
    claims = sorted(world.ledger.claims_on(claimed), key=lambda claim: claim.booked)
    return {
        "runs": any(suspended_by(claim, world) is None for claim in claims),
        "what": str(claimed),
        "subject": subject_data(claimed),
        "requesters": sorted({who for claim in claims for who in claim.requesters}),
        "claims": [_claim(claim, world) for claim in claims],
        "releases": [release_data(each) for each in release_causes.releases(world, claimed)],
    }


def commits(repo: Reader, path: str, commit: str, most: int) -> dict[str, Any]:
    """Return the commits that created, changed and removed a path."""
    history = repo.history(path, commit, most)
    return {
        "started": _commit(repo, history.started),
        "changes": [_commit(repo, entry) for entry in history.newest],
        "more_changes": history.more,
        "stopped": _commit(repo, history.stopped),
    }


def _claim(claim: Claim, world: World) -> dict[str, Any]:
    suspended = suspended_by(claim, world)
    kept = world.config.overrides.get(claim.keeping_override or "")
    return claim_data(claim) | {
        "release_by": release_causes.how_to_release(claim),
        "kept_by": override_data(kept, ("keep",)) if kept else None,
        "suspended_by": override_data(suspended, ("deny",)) if suspended else None,
    }


def _commit(repo: Reader, entry: LogEntry | None) -> dict[str, Any] | None:
    if entry is None:
        return None
    behind = repo.person_commits_behind(entry, _MOST_CARRIED_OUT)
    return commit_data(entry) | {"carries_out": [commit_data(each) for each in behind]}


def lines(answer: dict[str, Any]) -> Iterator[str]:
    """Yield an answer as lines of text."""
    at = answer["commit"][:10]
    title = f"{answer['kind']} {answer['name']}"
    if not answer["runs"]:
        word = "does not run"
        if answer["kind"] in ("file", "claim"):
            word = "no longer exists" if answer["stopped"] else "exists"
        yield f"{title} {word} at {at}"
        yield f"  file        {answer['file']}"
        if answer.get("denied_by"):
            yield f"  denied by   {_override_text(answer['denied_by'])}"
        if answer.get("claims"):
            yield from _claims(answer)
        yield from _history(answer)
        return
    yield f"{title} runs at {at}"
    yield f"  what        {answer['what']}"
    if "node" in answer:
        yield (
            f"  where       node {answer['node']}, cluster {answer['cluster']}, namespace "
            f"{answer['namespace']}, access domain {answer['domain']}"
        )
    yield f"  file        {answer['file']}"
    for each in answer.get("releases", ()):
        yield f"  needs       {each['name']} on {each['node']} ({each['file']})"
    yield from _claims(answer)
    if answer.get("shaped_by"):
        yield "configured by"
        for each in answer["shaped_by"]:
            entry = f" {each['entry']}" if each["entry"] else ""
            yield f"  {each['file']}{entry}: {each['what']}"
    if answer.get("overrides"):
        yield "overridden by"
        yield from (f"  {_override_text(each)}" for each in answer["overrides"])
    yield from _history(answer)


def _claims(answer: dict[str, Any]) -> Iterator[str]:
    yield "requested by"
    for claim in answer["claims"]:
        subject = f"{claim['subject']['kind']} '{claim['subject']['id']}'"
        yield f"  {', '.join(claim['requesters'])} since {time_text(claim['since'])}, for {subject}"
        yield f"    demand {claim['demand']}, request '{claim['request']}'{_lease(claim)}"
        yield f"    {claim['file']}"
        if claim["suspended_by"]:
            yield f"    suspended by {_override_text(claim['suspended_by'])}"
        if claim["kept_by"]:
            yield f"    kept by {_override_text(claim['kept_by'])}"
            yield f"    to release it: {claim['release_by']} by pull request"
        else:
            yield f"    to release it: {claim['release_by']}, or delete that file by pull request"


def _override_text(override: dict[str, Any]) -> str:
    until = f", until {time_text(override['until'])}" if override["until"] else ""
    return (
        f"{override['file']}: {', '.join(override['effects'])} (priority "
        f"{override['priority']}{until}), of {override['owner']}: {override['reason']}"
    )


def _lease(claim: dict[str, Any]) -> str:
    if claim["lease"] is None:
        return ""
    lease = claim["lease"]
    return f", lease of {lease['seconds']} s until {time_text(lease['until'])}"


def _history(answer: dict[str, Any]) -> Iterator[str]:
    if answer["stopped"]:
        yield "stopped by"
        yield from _commit_lines(answer["stopped"], why=True)
    if answer["changes"]:
        yield "changed by"
        for entry in answer["changes"]:
            yield from _commit_lines(entry, why=False)
    if answer["more_changes"]:
        yield f"  and {answer['more_changes']} earlier ones: -n, or git log -- {answer['file']}"
    if answer["started"]:
        yield "started by"
        yield from _commit_lines(answer["started"], why=True)


def _commit_lines(entry: dict[str, Any], *, why: bool) -> Iterator[str]:
    when, word = time_text(entry["time"]), entry["operation"] or "by hand"
    yield f"  {entry['commit'][:10]} {when}  {word}, {entry['author']}: {entry['summary']}"
    if why and entry["why"]:
        yield f"    {entry['why']}"
    for each in entry["carries_out"]:
        yield f"    carries out {each['commit'][:10]} by {each['author']}: {each['summary']}"
