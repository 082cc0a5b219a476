"""Finds the release, demand, node or other object whose name is given to ``demandops why``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from demandops.config.config import NODES_FILE
from demandops.errors import StateRepoError, closest, suggestion
from demandops.ledger import claim_file
from demandops.ledger.world import World
from demandops.plan.release import Release
from demandops.plan.views import release_causes
from demandops.quoting import quoted
from demandops.render.gitops.paths import path_of
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load import ledger_files
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader
from demandops.subject import Subject, SubjectKind

KINDS = (
    "release",
    "application",
    "connection",
    "demand",
    "node",
    "appdef",
    "requester",
    "override",
)
_MOST_LISTED = 8


@dataclass(frozen=True, slots=True)
class Match:
    """What a name identifies.

    ``kind`` is one of ``KINDS``, ``claim`` or ``file``.
    """

    kind: str
    name: str
    path: str = ""
    release: Release | None = None
    subject: Subject | None = None


def match_of(repo: Reader, snapshot: Snapshot, name: str, kind: str | None) -> Match:
    """Return the object that a name or path identifies; ``kind`` limits the search to one kind.

    Only the history up to the commit of ``snapshot`` counts.

    Raises:
        StateRepoError: if the name identifies nothing, or several things.
    """
    if name.startswith(("clusters/", "bootstrap/", f"{claim_file.LEDGER_ROOT}/")):
        return _by_path(repo, snapshot, name)
    world = snapshot.state
    matches = [each for each in _by_name(repo, snapshot, name) if kind in (None, each.kind)]
    matches = matches or list(_by_looser_match(repo, snapshot, name, kind))
    running = [
        each
        for each in matches
        if each.release or (each.subject and world.ledger.claims_on(each.subject))
    ]
    if len(running or matches) == 1:
        return (running or matches)[0]
    if matches:
        kinds = ", ".join(each.kind for each in matches)
        raise StateRepoError(
            f"{quoted(name)} names several things: {kinds}; choose one with --kind"
        )
    if "/" in name and _has_history(repo, snapshot, name.rstrip("/")):
        return _by_path(repo, snapshot, name)
    running_names = {release.name for release in release_causes.releases(world)}
    known = {
        *running_names,
        *repo.stopped_release_names(str(snapshot.commit)),
    }
    known |= {id for each in SubjectKind for id in world.ledger.subjects(each)}
    known |= {*world.config.nodes, *world.config.appdefs, *world.config.overrides}
    known |= {id for kind in ("demand", "requester") for id in world.ledger.indexed_names(kind)}
    parts = {part for running_name in running_names for part in running_name.split("-")}
    close = closest(name, known | parts)  # a part of a release's name is also accepted
    known = {close} if close else known
    if kind is not None:
        remedy = "; leave out --kind" if close in (None, name) else suggestion(name, known)
        raise StateRepoError(f"no {kind} is called {quoted(name)}{remedy}")
    raise StateRepoError(
        f"nothing called {quoted(name)} runs or ran up to commit {str(snapshot.commit)[:10]}"
        f"{suggestion(name, known)}"
    )


def _by_name(repo: Reader, snapshot: Snapshot, name: str) -> Iterator[Match]:
    world = snapshot.state
    release = release_causes.release_named(world, name)
    path = path_of(release) if release else repo.release_path(name, str(snapshot.commit))
    if path is None:  # a release that an override denies may never have run
        stopped = release_causes.denied_release_named(world, name)
        path = path_of(stopped[0]) if stopped else None
    if path is not None:
        yield Match("release", name, path, release)
    for kind in SubjectKind:
        subject = Subject(kind, name)
        folder = claim_file.folder_of(subject)
        if world.ledger.claims_on(subject) or _has_history(repo, snapshot, folder):
            yield Match(kind.value[:-1], name, folder, subject=subject)


def _by_looser_match(
    repo: Reader, snapshot: Snapshot, name: str, kind: str | None
) -> Iterator[Match]:
    """Yield the first object of this name that :func:`_named` finds.

    If there is none, yield the first of these that exists: a current release whose name contains
    ``name``, a held demand whose id begins with ``name``, an ended demand of exactly this id, an
    ended release whose name contains ``name``.

    Raises:
        StateRepoError: if the name is a part of several names.
    """
    world = snapshot.state
    found = next((one for one in _named(world, name) if kind in (None, one.kind)), None)
    if found is not None:
        yield found
    elif kind in (None, "release") and (running := _release_with(name, world)):
        yield Match("release", running.name, path_of(running), running)
    elif kind in (None, "demand") and (begun := _demand_from(name, world)):
        yield Match("demand", begun)
    elif kind in (None, "demand") and demand_commits(repo, snapshot, name):
        yield Match("demand", name)
    elif kind in (None, "release"):
        yield from _ended_release_with(repo, snapshot, name)


def _named(world: World, name: str) -> Iterator[Match]:
    """Yield each current object of this name that is no release, application or connection."""
    config = world.config
    if ("demand", name) in world.ledger.index:
        yield Match("demand", name)
    if name in config.nodes:
        yield Match("node", name, config.file_of(NODES_FILE, name))
    if name in config.appdefs:
        yield Match("appdef", name, f"appdefs/{name}/appdef.yaml")
    if name in config.overrides:
        yield Match("override", name, config.overrides[name].path)
    if ("requester", name) in world.ledger.index:
        yield Match("requester", name)


def _release_with(part: str, world: World) -> Release | None:
    """Return the release whose name contains ``part``; None if there is none.

    Raises:
        StateRepoError: if several releases have such a name.
    """
    found = {one.name: one for one in release_causes.releases(world) if part in one.name}
    return found[_the_only_name(part, [*found])] if found else None


def _ended_release_with(repo: Reader, snapshot: Snapshot, part: str) -> Iterator[Match]:
    """Yield the ended release whose name contains ``part``, if there is one.

    Raises:
        StateRepoError: if several ended releases have such a name.
    """
    commit = str(snapshot.commit)
    found = sorted(name for name in repo.stopped_release_names(commit) if part in name)
    if found:
        name = _the_only_name(part, found)
        yield Match("release", name, repo.release_path(name, commit) or "")


def _demand_from(start: str, world: World) -> str | None:
    """Return the demand id that begins with ``start``; None if there is none.

    Raises:
        StateRepoError: if several demands have such an id.
    """
    found = sorted(id for id in world.ledger.indexed_names("demand") if id.startswith(start))
    return _the_only_name(start, found, "demand ids begin with {}") if found else None


def _the_only_name(
    part: str, names: list[str], what: str = "releases have {} in their name"
) -> str:
    if len(names) == 1:
        return names[0]
    listed = ", ".join(names[:_MOST_LISTED])
    more = ", …" if len(names) > _MOST_LISTED else ""
    raise StateRepoError(
        f"{len(names)} {what.format(quoted(part))}; give a longer part: {listed}{more}"
    )


def demand_commits(repo: Reader, snapshot: Snapshot, id: str) -> list[LogEntry]:
    """Return the generator's commits about a demand up to the snapshot's, newest first."""
    entries = repo.log(str(snapshot.commit))
    return [entry for entry in entries if id in entry.trailers.get("Demand-Id", ())]


def _by_path(repo: Reader, snapshot: Snapshot, path: str) -> Match:
    path = path.rstrip("/")
    text = repo.file_reader(str(snapshot.commit))(path)
    key = ledger_files.key_of(path, snapshot.state.ledger)
    if key is not None:
        return Match("claim", key.demand, path, subject=key.subject)
    name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
    release = release_causes.release_named(snapshot.state, name)
    if release is not None and path_of(release) == path:
        return Match("release", name, path, release)
    if text is None and not _has_history(repo, snapshot, path):
        raise StateRepoError(
            f"{quoted(path)} is not in the state repo at commit {str(snapshot.commit)[:10]} and "
            "never was before; correct the path"
        )
    if text is not None or not path.startswith(("clusters/", "ledger/")):
        return Match("file", path, path)
    return Match("claim" if claim_file.kind_of(path) else "release", name, path)


def _has_history(repo: Reader, snapshot: Snapshot, path: str) -> bool:
    history = repo.history(path, str(snapshot.commit), 0)
    return bool(history.started or history.stopped)
