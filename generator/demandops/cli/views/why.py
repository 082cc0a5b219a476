"""``demandops why``: why something runs: its requesters, configuration, overrides, commits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import click

from demandops.cli.json_output import (
    claim_data,
    commit_data,
    output_option,
    override_data,
    place_data,
    release_data,
    show,
    subject_data,
    time_text,
)
from demandops.cli.output import at_option, state_repo_option
from demandops.cli.views.diff import loaded
from demandops.demand.claim import Claim
from demandops.errors import StateRepoError, suggestion
from demandops.ledger import claim_file
from demandops.ledger.world import World
from demandops.plan.overrides.claim_overrides import suspended_by, without_suspended
from demandops.plan.release import Release
from demandops.plan.views import release_causes
from demandops.quoting import quoted
from demandops.render.gitops.paths import path_of
from demandops.staterepo import reader
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load import ledger_files
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader
from demandops.subject import Subject, SubjectKind

_KINDS = ("release", "application", "connection")
_MOST_CARRIED_OUT = 5


@dataclass(frozen=True, slots=True)
class _Match:
    """What the name means: a release, a claimed subject, or another file of the state repo."""

    kind: str
    name: str
    path: str
    release: Release | None = None
    subject: Subject | None = None


@click.command()
@click.argument("name", metavar="RELEASE|CONNECTION|APPLICATION|PATH")
@state_repo_option
@at_option
@click.option(
    "--kind",
    type=click.Choice(_KINDS),
    help="What the name means, if it could mean several things.",
)
@click.option(
    "-n",
    "--max-count",
    "most",
    type=click.IntRange(0),
    default=10,
    show_default=True,
    help="List at most this many of the commits that changed it.",
)
@output_option
def why(
    name: str, state_repo: str, at: str | None, kind: str | None, most: int, output: str
) -> None:
    """Explain why something runs or ran.

    Shown are the requesters, the configuration and overrides that apply, and the commits. Give the
    name of a release, the id of an application or a connection, or a path below clusters/ or
    ledger/. If it no longer runs, the commit that stopped it is shown.
    """
    with reader.opened(state_repo) as repo:
        snapshot = loaded(repo, at)
        match = _match(repo, snapshot, name, kind)
        answer: dict[str, Any] = {
            "commit": str(snapshot.commit),
            "kind": match.kind,
            "name": match.name,
        }
        if match.release is not None:
            answer |= _of_release(snapshot.state, match.release)
        elif match.subject is not None:
            answer |= _of_subject(snapshot.state, match.subject)
        else:
            answer |= {"runs": False, **_denied(snapshot.state, match)}
        answer |= {"file": match.path, **_history(repo, snapshot, match.path, most)}
    show(output, answer, _lines(answer))


def _match(repo: Reader, snapshot: Snapshot, name: str, kind: str | None) -> _Match:
    """Return the object that a name identifies; raise if it fits none, or several."""
    if name.startswith(("clusters/", "bootstrap/", f"{claim_file.LEDGER_ROOT}/")):
        return _by_path(repo, snapshot, name)
    world = snapshot.state
    matches = [each for each in _by_name(repo, snapshot, name) if kind in (None, each.kind)]
    running = [
        each
        for each in matches
        if each.release or (each.subject and world.ledger.claims_on(each.subject))
    ]
    if len(running or matches) == 1:
        return (running or matches)[0]
    if matches:
        kinds = ", ".join(each.kind for each in matches)
        raise StateRepoError(f"{quoted(name)} can mean several: {kinds}; choose one with --kind")
    if "/" in name and _has_history(repo, snapshot, name.rstrip("/")):
        return _by_path(repo, snapshot, name)
    known = {
        *(release.name for release in release_causes.releases(world)),
        *repo.stopped_release_names(str(snapshot.commit)),
    }
    known |= {id for each in SubjectKind for id in world.ledger.subjects(each)}
    raise StateRepoError(f"nothing called {quoted(name)} runs or ever ran{suggestion(name, known)}")


def _by_name(repo: Reader, snapshot: Snapshot, name: str) -> Iterator[_Match]:
    world = snapshot.state
    release = release_causes.release_named(world, name)
    path = path_of(release) if release else repo.release_path(name, str(snapshot.commit))
    if path is None:  # a release that an override denies may never have run
        stopped = release_causes.denied_release_named(world, name)
        path = path_of(stopped[0]) if stopped else None
    if path is not None:
        yield _Match("release", name, path, release)
    for kind in SubjectKind:
        subject = Subject(kind, name)
        folder = claim_file.folder_of(subject)
        if world.ledger.claims_on(subject) or _has_history(repo, snapshot, folder):
            yield _Match(kind.value[:-1], name, folder, subject=subject)


def _by_path(repo: Reader, snapshot: Snapshot, path: str) -> _Match:
    path = path.rstrip("/")
    text = repo.file_reader(str(snapshot.commit))(path)
    key = ledger_files.key_of(path, snapshot.state.ledger)
    if key is not None:
        return _Match("claim", key.demand, path, subject=key.subject)
    name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
    release = release_causes.release_named(snapshot.state, name)
    if release is not None and path_of(release) == path:
        return _Match("release", name, path, release)
    if text is None and not _has_history(repo, snapshot, path):
        raise StateRepoError(f"{quoted(path)} is not in the state repo and never was")
    if text is not None or not path.startswith(("clusters/", "ledger/")):
        return _Match("file", path, path)
    return _Match("claim" if claim_file.kind_of(path) else "release", name, path)


def _has_history(repo: Reader, snapshot: Snapshot, path: str) -> bool:
    history = repo.history(path, str(snapshot.commit), 0)
    return bool(history.started or history.stopped)


def _of_release(world: World, running: Release) -> dict[str, Any]:
    claims = release_causes.claims_behind(without_suspended(world).ledger, running)
    return {
        "runs": True,
        **place_data(running),
        **_claims(claims, world),
        "shaped_by": [
            {"file": file, "entry": entry or None, "what": what}
            for file, entry, what in release_causes.shaping_files(running, world.config)
        ],
        "overrides": [override_data(*each) for each in running.shaping.by],
    }


def _denied(world: World, match: _Match) -> dict[str, Any]:
    """Return why a release does not run although claims request it, if an override denies it."""
    if match.kind != "release":
        return {}
    name = match.path.rsplit("/", 1)[-1].removesuffix(".yaml")
    stopped = release_causes.denied_release_named(world, name)
    if stopped is None:
        return {}
    return {**place_data(stopped[0]), "denied_by": override_data(stopped[1], ("deny",))}


def _of_subject(world: World, claimed: Subject) -> dict[str, Any]:
    claims = sorted(world.ledger.claims_on(claimed), key=lambda claim: claim.booked)
    return {
        "runs": any(suspended_by(claim, world) is None for claim in claims),
        "what": str(claimed),
        "subject": subject_data(claimed),
        **_claims(claims, world),
        "releases": [release_data(each) for each in release_causes.releases(world, claimed)],
    }


def _claims(claims: list[Claim], world: World) -> dict[str, Any]:
    rows = []
    for claim in claims:
        suspended = suspended_by(claim, world)
        kept = world.config.overrides.get(claim.keeping_override or "")
        rows.append(
            claim_data(claim)
            | {
                "release_by": release_causes.how_to_release(claim),
                "kept_by": override_data(kept, ("keep",)) if kept else None,
                "suspended_by": override_data(suspended, ("deny",)) if suspended else None,
            }
        )
    return {
        "requesters": sorted({who for claim in claims for who in claim.requesters}),
        "claims": rows,
    }


def _history(repo: Reader, snapshot: Snapshot, path: str, most: int) -> dict[str, Any]:
    history = repo.history(path, str(snapshot.commit), most)

    def row(entry: LogEntry | None) -> dict[str, Any] | None:
        if entry is None:
            return None
        behind = repo.person_commits_behind(entry, _MOST_CARRIED_OUT)
        return commit_data(entry) | {"carries_out": [commit_data(each) for each in behind]}

    return {
        "started": row(history.started),
        "changes": [row(entry) for entry in history.newest],
        "more_changes": history.more,
        "stopped": row(history.stopped),
    }


def _lines(answer: dict[str, Any]) -> Iterator[str]:
    runs, word = answer["runs"], "runs" if answer["runs"] else "does not run"
    if answer["kind"] in ("file", "claim") and not runs:
        word = "no longer exists" if answer["stopped"] else "exists"
    yield f"{answer['kind']} {answer['name']} {word} at {answer['commit'][:10]}"
    if runs:
        yield f"  what        {answer['what']}"
    if runs and "node" in answer:
        yield (
            f"  where       node {answer['node']}, cluster {answer['cluster']}, namespace "
            f"{answer['namespace']}, access domain {answer['domain']}"
        )
    yield f"  file        {answer['file']}"
    if answer.get("denied_by"):
        yield f"  denied by   {_override_text(answer['denied_by'])}"
    for each in answer.get("releases", ()) if runs else ():
        yield f"  needs       {each['name']} on {each['node']} ({each['file']})"
    if runs or answer.get("claims"):
        yield from _claim_lines(answer["claims"])
    if answer.get("shaped_by"):
        yield "configured by"
        for each in answer["shaped_by"]:
            entry = f" {each['entry']}" if each["entry"] else ""
            yield f"  {each['file']}{entry}: {each['what']}"
    if answer.get("overrides"):
        yield "overridden by"
        yield from (f"  {_override_text(each)}" for each in answer["overrides"])
    yield from _history_lines(answer)


def _claim_lines(claims: list[dict[str, Any]]) -> Iterator[str]:
    yield "requested by"
    for claim in claims:
        lease, subject = claim["lease"], f"{claim['subject']['kind']} '{claim['subject']['id']}'"
        until = (
            f", lease of {lease['seconds']} s until {time_text(lease['until'])}" if lease else ""
        )
        version = f", version {claim['version']}" if claim["version"] else ""
        yield f"  {', '.join(claim['requesters'])} since {time_text(claim['since'])}, for {subject}"
        yield f"    demand {claim['demand']}, request '{claim['request']}'{version}{until}"
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


def _history_lines(answer: dict[str, Any]) -> Iterator[str]:
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
