"""The answers of ``demandops why``, as plain data and as lines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from demandops.config.override import Override
from demandops.demand.claim import Claim
from demandops.ledger import claim_file
from demandops.ledger.world import World
from demandops.plan.overrides.suspended_claims import suspended_by, without_suspended
from demandops.plan.release import Release
from demandops.plan.views import explanation
from demandops.render.gitops.paths import path_of
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader
from demandops.subject import Subject

_MOST_CARRIED_OUT = 5


def release(snapshot: Snapshot, running: Release) -> dict[str, Any]:
    """Return why a release runs."""
    world = snapshot.state
    claims = explanation.claims_behind(without_suspended(world).ledger, running)
    return {
        "runs": True,
        "what": running.description,
        **_where(running),
        "requesters": sorted({who for claim in claims for who in claim.requesters}),
        "claims": [_claim(claim, world) for claim in claims],
        "shaped_by": [
            {"file": each.file, "entry": each.entry or None, "what": each.what}
            for each in explanation.shaping_files(running, world.config)
        ],
        "overrides": [_override(by, effects) for by, effects in running.shaping.by],
    }


def denied(stopped: Release, by: Override) -> dict[str, Any]:
    """Return why a release does not run although claims request it."""
    return {
        "runs": False,
        "what": stopped.description,
        **_where(stopped),
        "denied_by": _override(by, ("deny",)),
    }


def subject(snapshot: Snapshot, claimed: Subject) -> dict[str, Any]:
    """Return the claims on an application or a connection, and the releases that it needs."""
    world = snapshot.state
    claims = sorted(world.ledger.claims_on(claimed), key=lambda claim: claim.booked)
    return {
        "runs": any(suspended_by(claim, world) is None for claim in claims),
        "what": str(claimed),
        "requesters": sorted({who for claim in claims for who in claim.requesters}),
        "claims": [_claim(claim, world) for claim in claims],
        "releases": [
            {"name": each.name, **_where(each), "file": path_of(each)}
            for each in explanation.releases(world, claimed)
        ],
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


def _where(release: Release) -> dict[str, Any]:
    return {
        "cluster": release.node.cluster,
        "domain": release.domain.name,
        "namespace": release.domain.namespace,
        "node": release.node.id,
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


def _claim(claim: Claim, world: World) -> dict[str, Any]:
    lease = claim.lease
    suspended = suspended_by(claim, world)
    kept = explanation.keeping_override(claim, world.config)
    return {
        "subject": str(claim.subject),
        "demand": claim.demand,
        "request": claim.request,
        "requesters": list(claim.requesters),
        "since": claim.booked.isoformat(),
        "lease": {"seconds": lease.seconds, "until": lease.until.isoformat()} if lease else None,
        "file": claim_file.path_of(claim.key),
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
            {"commit": each.commit, "author": each.author, "summary": each.summary}
            for each in repo.person_commits_behind(entry, _MOST_CARRIED_OUT)
        ],
    }


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
        since = claim["since"][:19].replace("T", " ")
        yield f"  {', '.join(claim['requesters'])} since {since} UTC, for {claim['subject']}"
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
    until = f", until {override['until'][:19].replace('T', ' ')} UTC" if override["until"] else ""
    return (
        f"{override['file']}: {', '.join(override['effects'])} (priority "
        f"{override['priority']}{until}), of {override['owner']}: {override['reason']}"
    )


def _lease(claim: dict[str, Any]) -> str:
    if claim["lease"] is None:
        return ""
    until = claim["lease"]["until"][:19].replace("T", " ")
    return f", lease of {claim['lease']['seconds']} s until {until} UTC"


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
    when = entry["time"][:19].replace("T", " ")
    word = entry["operation"] or "by hand"
    yield f"  {entry['commit'][:10]} {when} UTC  {word}, {entry['author']}: {entry['summary']}"
    if why and entry["why"]:
        yield f"    {entry['why']}"
    for each in entry["carries_out"]:
        yield f"    carries out {each['commit'][:10]} by {each['author']}: {each['summary']}"
