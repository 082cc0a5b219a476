"""``demandops why``: why something runs: its requesters, configuration, overrides, commits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import click

from demandops.cli.json_output import output_option, print_json
from demandops.cli.output import at_option, console, progress, state_repo_option, warn_of
from demandops.cli.views import why_output
from demandops.errors import StateRepoError, quoted, suggestion
from demandops.ledger import claim_file
from demandops.plan.release import Release
from demandops.plan.views import release_causes
from demandops.render.gitops.paths import path_of
from demandops.staterepo import reader
from demandops.staterepo.load import ledger_files
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader
from demandops.subject import Subject, SubjectKind

_KINDS = ("release", "application", "connection")


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
    help="The greatest number of commits to list that changed it.",
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
        with progress("reading the ledger") as report:
            snapshot = repo.last_valid_snapshot(repo.commit(at), report)
        warn_of(repo.problems_of(snapshot))
        match = _match(repo, snapshot, name, kind)
        commit = str(snapshot.commit)
        answer: dict[str, Any] = {"commit": commit, "kind": match.kind, "name": match.name}
        if match.release is not None:
            answer |= why_output.release(snapshot, match.release)
        elif match.subject is not None:
            answer |= why_output.subject(snapshot, match.subject)
        else:
            answer |= {"runs": False, **_denied(snapshot, match)}
        answer["file"] = match.path
        answer |= why_output.commits(repo, match.path, commit, most)
    if output == "json":
        print_json(answer)
        return
    out = console()
    for line in why_output.lines(answer):
        out.print(line, soft_wrap=True)


def _match(repo: Reader, snapshot: Snapshot, name: str, kind: str | None) -> _Match:
    """Return the object that a name identifies.

    Raises:
        StateRepoError: the name fits no object, or several.
    """
    if name.startswith(("clusters/", "bootstrap/", f"{claim_file.LEDGER_ROOT}/")):
        return _by_path(repo, snapshot, name)
    matches = [each for each in _by_name(repo, snapshot, name) if kind in (None, each.kind)]
    running = [each for each in matches if each.release or _is_claimed(snapshot, each)]
    if len(running or matches) == 1:
        return (running or matches)[0]
    if matches:
        kinds = ", ".join(each.kind for each in matches)
        raise StateRepoError(f"{quoted(name)} can mean several: {kinds}; choose one with --kind")
    if "/" in name and _has_history(repo, snapshot, name.rstrip("/")):
        return _by_path(repo, snapshot, name)
    world = snapshot.state
    known = {
        *(release.name for release in release_causes.releases(world)),
        *repo.stopped_release_names(str(snapshot.commit)),
    }
    known |= {id for each in SubjectKind for id in world.ledger.subjects(each)}
    raise StateRepoError(f"nothing called {quoted(name)} runs or ever ran{suggestion(name, known)}")


def _by_name(repo: Reader, snapshot: Snapshot, name: str) -> list[_Match]:
    world = snapshot.state
    matches = []
    release = release_causes.release_named(world, name)
    path = path_of(release) if release else repo.release_path(name, str(snapshot.commit))
    if path is None:  # a release that an override denies may never have run
        stopped = release_causes.denied_release_named(world, name)
        path = path_of(stopped[0]) if stopped else None
    if path is not None:
        matches.append(_Match("release", name, path, release))
    for kind in SubjectKind:
        subject = Subject(kind, name)
        folder = claim_file.folder_of(subject)
        if world.ledger.claims_on(subject) or _has_history(repo, snapshot, folder):
            matches.append(_Match(kind.value[:-1], name, folder, subject=subject))
    return matches


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


def _denied(snapshot: Snapshot, match: _Match) -> dict[str, Any]:
    """Return the override that denies a release, if there is one."""
    if match.kind != "release":
        return {}
    name = match.path.rsplit("/", 1)[-1].removesuffix(".yaml")
    stopped = release_causes.denied_release_named(snapshot.state, name)
    return why_output.denied(*stopped) if stopped else {}


def _is_claimed(snapshot: Snapshot, match: _Match) -> bool:
    return match.subject is not None and bool(snapshot.state.ledger.claims_on(match.subject))


def _has_history(repo: Reader, snapshot: Snapshot, path: str) -> bool:
    history = repo.history(path, str(snapshot.commit), 0)
    return bool(history.started or history.stopped)
