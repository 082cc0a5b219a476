"""``demandops why``: what runs, who asked for it, what shaped it, and by which commits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import click

from demandops.cli.output import (
    REV_HELP,
    console,
    output_option,
    print_json,
    progress,
    state_repo_option,
    warn_of,
)
from demandops.cli.views import why_answer
from demandops.demand.claim import Subject, SubjectKind
from demandops.errors import StateRepoError, quoted, suggestion
from demandops.ledger import claim_file as ledger_format
from demandops.plan.release import Release
from demandops.plan.views import explanation
from demandops.render.gitops.paths import path_of
from demandops.staterepo import reader
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader

_KINDS = ("release", "application", "connection")


@dataclass(frozen=True, slots=True)
class _Asked:
    """What the question is about: a release, a subject, or a file that is neither (any more)."""

    kind: str
    name: str
    path: str
    release: Release | None = None
    subject: Subject | None = None


@click.command()
@click.argument("name", metavar="RELEASE|CONNECTION|APPLICATION|PATH")
@state_repo_option
@click.option("--at", "at", metavar="REV|TIME", help=f"{REV_HELP}; the newest by default.")
@click.option(
    "--kind",
    type=click.Choice(_KINDS),
    help="What the name is of, where it could be several things.",
)
@click.option(
    "-n",
    "--max-count",
    "most",
    type=click.IntRange(0),
    default=10,
    show_default=True,
    help="List at most so many of the commits that changed it.",
)
@output_option
def why(
    name: str, state_repo: str, at: str | None, kind: str | None, most: int, output: str
) -> None:
    """Tell why something runs, or ran: who asks for it, what shaped it, and which commits did.

    It takes the name of a release, the id of an application or a connection, or a path below
    clusters/ or ledger/. Of what runs no more it tells when it was stopped, by whom and why.
    """
    with reader.opened(state_repo) as repo:
        with progress("reading the ledger") as tell:
            snapshot = repo.last_valid(repo.commit(at), tell)
        warn_of(repo.problems_of(snapshot))
        asked = _understood(repo, snapshot, name, kind)
        commit = str(snapshot.commit)
        found: dict[str, Any] = {"commit": commit, "kind": asked.kind, "name": asked.name}
        if asked.release is not None:
            found |= why_answer.release(snapshot, asked.release)
        elif asked.subject is not None:
            found |= why_answer.subject(snapshot, asked.subject)
        else:
            found |= {"runs": False, **_denied(snapshot, asked)}
        found["file"] = asked.path
        found |= why_answer.commits(repo, asked.path, commit, most)
    if output == "json":
        print_json(found)
        return
    out = console()
    for line in why_answer.lines(found):
        out.print(line, soft_wrap=True)


def _understood(repo: Reader, snapshot: Snapshot, name: str, kind: str | None) -> _Asked:
    """Find what a name means.

    Raises:
        StateRepoError: where it means nothing, or several things.
    """
    if name.startswith(("clusters/", "bootstrap/", f"{ledger_format.LEDGER_ROOT}/")):
        return _by_path(repo, snapshot, name)
    found = [one for one in _by_name(repo, snapshot, name) if kind in (None, one.kind)]
    running = [one for one in found if one.release or _is_held(snapshot, one)]
    if len(running or found) == 1:
        return (running or found)[0]
    if found:
        kinds = ", ".join(one.kind for one in found)
        raise StateRepoError(f"{quoted(name)} names more than one: {kinds}; say which by --kind")
    if "/" in name and _has_history(repo, snapshot, name.rstrip("/")):
        return _by_path(repo, snapshot, name)
    ledger, config = snapshot.state.ledger, snapshot.state.config
    known = {*explanation.names(ledger, config), *repo.ever_stopped(str(snapshot.commit))}
    known |= {id for one in SubjectKind for id in ledger.subjects(one)}
    raise StateRepoError(
        f"nothing called {quoted(name)} runs, or ever did{suggestion(name, known)}"
    )


def _by_name(repo: Reader, snapshot: Snapshot, name: str) -> list[_Asked]:
    ledger, config = snapshot.state.ledger, snapshot.state.config
    found = []
    release = explanation.find(ledger, config, name)
    path = path_of(release) if release else repo.path_called(name, str(snapshot.commit))
    if path is None:  # one that an override denies may never have run
        stopped = explanation.denied_called(ledger, config, name)
        path = path_of(stopped[0]) if stopped else None
    if path is not None:
        found.append(_Asked("release", name, path, release))
    for kind in SubjectKind:
        subject = Subject(kind, name)
        folder = ledger_format.folder_of(subject)
        if ledger.of(subject) or _has_history(repo, snapshot, folder):
            found.append(_Asked(kind.value[:-1], name, folder, subject=subject))
    return found


def _by_path(repo: Reader, snapshot: Snapshot, path: str) -> _Asked:
    path = path.rstrip("/")
    text = repo.file_reader(str(snapshot.commit))(path)
    key = snapshot.keys.get(path)
    if key is not None:
        return _Asked("claim", key.demand, path, subject=key.subject)
    name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
    release = explanation.find(snapshot.state.ledger, snapshot.state.config, name)
    if release is not None and path_of(release) == path:
        return _Asked("release", name, path, release)
    if text is None and not _has_history(repo, snapshot, path):
        raise StateRepoError(f"{quoted(path)} is no file of the state repo, and never was")
    if text is not None or not path.startswith(("clusters/", "ledger/")):
        return _Asked("file", path, path)
    return _Asked("claim" if ledger_format.kind_of(path) else "release", name, path)


def _denied(snapshot: Snapshot, asked: _Asked) -> dict[str, Any]:
    """Return which override keeps a release from running that is asked for, if one does."""
    if asked.kind != "release":
        return {}
    name = asked.path.rsplit("/", 1)[-1].removesuffix(".yaml")
    stopped = explanation.denied_called(snapshot.state.ledger, snapshot.state.config, name)
    return why_answer.denied(*stopped) if stopped else {}


def _is_held(snapshot: Snapshot, asked: _Asked) -> bool:
    return asked.subject is not None and bool(snapshot.state.ledger.of(asked.subject))


def _has_history(repo: Reader, snapshot: Snapshot, path: str) -> bool:
    history = repo.history(path, str(snapshot.commit), 0)
    return bool(history.started or history.stopped)
