"""The answers of ``demandops why``, as plain data and as lines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from demandops.config.config import Config
from demandops.config.override import Override
from demandops.demand.claim import Claim, Subject
from demandops.ledger import claim_file as ledger_format
from demandops.plan.overrides.claims_in_force import in_force, suspended_by
from demandops.plan.release import Release
from demandops.plan.views import explanation
from demandops.render.changes.changeset import described
from demandops.render.gitops.paths import path_of
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader

_PEOPLES_COMMITS = 5


def release(snapshot: Snapshot, found: Release) -> dict[str, Any]:
    """Return why a release runs."""
    ledger, config = snapshot.state.ledger, snapshot.state.config
    claims = explanation.claims_behind(in_force(ledger, config), found)
    return {
        "runs": True,
        "what": described(None, found, stood=False).what,
        **_where(found),
        "requesters": sorted({who for claim in claims for who in claim.requesters}),
        "claims": [_claim(claim, config) for claim in claims],
        "shaped_by": [
            {"file": one.file, "entry": one.entry or None, "what": one.what}
            for one in explanation.shaped_by(found, config)
        ],
        "overrides": [_override(one, effects) for one, effects in found.shaping.by],
    }


def denied(found: Release, by: Override) -> dict[str, Any]:
    """Return what keeps a release from running that claims ask for."""
    return {
        "runs": False,
        "what": described(None, found, stood=False).what,
        **_where(found),
        "denied_by": _override(by, ("deny",)),
    }


def subject(snapshot: Snapshot, found: Subject) -> dict[str, Any]:
    """Return who holds an application or a connection, and what runs because of that."""
    ledger, config = snapshot.state.ledger, snapshot.state.config
    claims = sorted(ledger.of(found), key=lambda claim: claim.booked)
    releases = explanation.releases_of(ledger, config, found)
    return {
        "runs": any(suspended_by(claim, config) is None for claim in claims),
        "what": str(found),
        "requesters": sorted({who for claim in claims for who in claim.requesters}),
        "claims": [_claim(claim, config) for claim in claims],
        "releases": [{"name": one.name, **_where(one), "file": path_of(one)} for one in releases],
    }


def commits(repo: Reader, path: str, commit: str, most: int) -> dict[str, Any]:
    """Return which commits made a path what it is."""
    history = repo.history(path, commit, most)
    return {
        "started": _commit(repo, history.started),
        "changes": [_commit(repo, entry) for entry in history.newest],
        "more_changes": history.more,
        "stopped": _commit(repo, history.stopped),
    }


def _where(found: Release) -> dict[str, Any]:
    return {
        "cluster": found.node.cluster,
        "domain": found.domain.name,
        "namespace": found.domain.namespace,
        "node": found.node.id,
    }


def _override(override: Override, effects: Iterable[str]) -> dict[str, Any]:
    return {
        "file": override.path,
        "effects": list(effects),
        "priority": override.priority,
        "owner": override.owner,
        "reason": override.reason,
        "until": override.end.isoformat() if override.end else None,
    }


def _claim(claim: Claim, config: Config) -> dict[str, Any]:
    lease = claim.lease
    suspended, kept = suspended_by(claim, config), explanation.kept_by(claim, config)
    return {
        "subject": str(claim.subject),
        "demand": claim.demand,
        "request": claim.request,
        "requesters": list(claim.requesters),
        "since": claim.booked.isoformat(),
        "lease": {"seconds": lease.seconds, "until": lease.until.isoformat()} if lease else None,
        "file": ledger_format.path_of(claim.key),
        "release_by": explanation.how_to_release(claim),
        "kept_by": _override(kept, ("keep",)) if kept else None,
        "suspended_by": _override(suspended, ("deny",)) if suspended else None,
    }


def _commit(repo: Reader, entry: LogEntry | None) -> dict[str, Any] | None:
    if entry is None:
        return None
    return {
        "commit": entry.commit,
        "time": entry.time.isoformat(),
        "author": entry.author,
        "operation": entry.first("Operation") or None,
        "requesters": entry.trailers.get("Requester", []),
        "summary": entry.summary,
        "why": entry.why or None,
        "carries_out": [
            {"commit": one.commit, "author": one.author, "summary": one.summary}
            for one in repo.person_commits_behind(entry, _PEOPLES_COMMITS)
        ],
    }


def lines(found: dict[str, Any]) -> Iterator[str]:
    """Yield an answer as people read it."""
    at = found["commit"][:10]
    told = f"{found['kind']} {found['name']}"
    if not found["runs"]:
        word = "does not run"
        if found["kind"] in ("file", "claim"):
            word = "is gone" if found["stopped"] else "stands"
        yield f"{told} {word} at {at}"
        yield f"  file        {found['file']}"
        if found.get("denied_by"):
            yield f"  denied by   {_told_override(found['denied_by'])}"
        if found.get("claims"):
            yield from _claims(found)
        yield from _history(found)
        return
    yield f"{told} runs at {at}"
    yield f"  what        {found['what']}"
    if "node" in found:
        yield (
            f"  where       node {found['node']}, cluster {found['cluster']}, namespace "
            f"{found['namespace']}, access domain {found['domain']}"
        )
    yield f"  file        {found['file']}"
    for one in found.get("releases", ()):
        yield f"  needs       {one['name']} on {one['node']} ({one['file']})"
    yield from _claims(found)
    if found.get("shaped_by"):
        yield "shaped by"
        for one in found["shaped_by"]:
            entry = f" {one['entry']}" if one["entry"] else ""
            yield f"  {one['file']}{entry}: {one['what']}"
    if found.get("overrides"):
        yield "overridden by"
        yield from (f"  {_told_override(one)}" for one in found["overrides"])
    yield from _history(found)


def _claims(found: dict[str, Any]) -> Iterator[str]:
    yield "asked for by"
    for claim in found["claims"]:
        since = claim["since"][:19].replace("T", " ")
        yield f"  {', '.join(claim['requesters'])} since {since} UTC, for {claim['subject']}"
        yield f"    demand {claim['demand']}, request '{claim['request']}'{_lease(claim)}"
        yield f"    {claim['file']}"
        if claim["suspended_by"]:
            yield f"    suspended by {_told_override(claim['suspended_by'])}"
        if claim["kept_by"]:
            yield f"    kept by {_told_override(claim['kept_by'])}"
            yield f"    to release it: {claim['release_by']} by pull request"
        else:
            yield f"    to release it: {claim['release_by']}, or delete that file by pull request"


def _told_override(one: dict[str, Any]) -> str:
    until = f", until {one['until'][:19].replace('T', ' ')} UTC" if one["until"] else ""
    return (
        f"{one['file']}: {', '.join(one['effects'])} (priority {one['priority']}{until}), of "
        f"{one['owner']}: {one['reason']}"
    )


def _lease(claim: dict[str, Any]) -> str:
    if claim["lease"] is None:
        return ""
    until = claim["lease"]["until"][:19].replace("T", " ")
    return f", lease of {claim['lease']['seconds']} s until {until} UTC"


def _history(found: dict[str, Any]) -> Iterator[str]:
    if found["stopped"]:
        yield "stopped by"
        yield from _told(found["stopped"], why=True)
    if found["changes"]:
        yield "changed by"
        for entry in found["changes"]:
            yield from _told(entry, why=False)
    if found["more_changes"]:
        yield f"  and {found['more_changes']} more before (-n); git log -- {found['file']}"
    if found["started"]:
        yield "started by"
        yield from _told(found["started"], why=True)


def _told(entry: dict[str, Any], *, why: bool) -> Iterator[str]:
    when = entry["time"][:19].replace("T", " ")
    word = entry["operation"] or "by hand"
    yield f"  {entry['commit'][:10]} {when} UTC  {word}, {entry['author']}: {entry['summary']}"
    if why and entry["why"]:
        yield f"    {entry['why']}"
    for one in entry["carries_out"]:
        yield f"    carries out {one['commit'][:10]} by {one['author']}: {one['summary']}"
