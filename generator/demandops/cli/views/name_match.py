"""Finds the release, demand, node or other object whose name is given to ``demandops why``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from demandops.base.errors import StateRepoError, closest, suggestion
from demandops.base.naming import Subject, SubjectKind
from demandops.base.quoting import quoted
from demandops.model.config.config import NODES_FILE
from demandops.model.ledger import claim_file
from demandops.model.ledger.ledger import World
from demandops.model.release import Release
from demandops.render.paths import path_of
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.load import ledger_files
from demandops.repo.load.snapshot import Snapshot
from demandops.repo.reader import Reader
from demandops.views import release_causes

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

    Only the history up to the commit of ``snapshot`` counts. A StateRepoError says that the name
    identifies nothing, or several things.
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
    names = {*running_names, *repo.stopped_release_names(str(snapshot.commit))}
    names |= {id for each in SubjectKind for id in world.ledger.subjects(each)}
    names |= {*world.config.nodes, *world.config.appdefs, *world.config.overrides}
    names |= {id for kind in ("demand", "requester") for id in world.ledger.indexed_names(kind)}
    parts = {part for running_name in running_names for part in running_name.split("-")}
    close = closest(name, names | parts)  # a part of a release's name is also accepted
    names = {close} if close else names
    if kind is not None:
        remedy = "; leave out --kind" if close in (None, name) else suggestion(name, names)
        raise StateRepoError(f"no {kind} is called {quoted(name)}{remedy}")
    raise StateRepoError(
        f"nothing called {quoted(name)} runs or ran up to commit {str(snapshot.commit)[:10]}"
        f"{suggestion(name, names)}"
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
    """Yield what a name may mean that is no whole name of a release or subject."""
    world, commit = snapshot.state, str(snapshot.commit)
    named = next((each for each in _named(world, name) if kind in (None, each.kind)), None)
    if named is not None:
        yield named
        return
    # what runs or is held comes before what has ended
    if kind in (None, "release"):
        parts = {each.name: each for each in release_causes.releases(world) if name in each.name}
        if parts:
            release = parts[_the_only_name(name, [*parts])]
            yield Match("release", release.name, path_of(release), release)
            return
    if kind in (None, "demand"):
        ids = sorted(id for id in world.ledger.indexed_names("demand") if id.startswith(name))
        if ids:
            yield Match("demand", _the_only_name(name, ids, "demand ids begin with {}"))
            return
        if demand_commits(repo, snapshot, name):
            yield Match("demand", name)
            return
    if kind in (None, "release"):
        ended = sorted(each for each in repo.stopped_release_names(commit) if name in each)
        if ended:
            only = _the_only_name(name, ended)
            yield Match("release", only, repo.release_path(only, commit) or "")


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
