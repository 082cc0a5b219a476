"""``demandops diff``: what differs between two commits, in bookkeeping and in what runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any

import click

from demandops.cli.output import (
    SIGNS,
    console,
    output_option,
    print_json,
    progress,
    state_repo_option,
    warn_of,
)
from demandops.plan.views.bookkeeping import bookkeeping
from demandops.plan.views.bookkeeping_diff import EntryChange, difference
from demandops.render.changes.commit_diff import ReleaseDifference, compare
from demandops.render.gitops.paths import CLUSTERS_ROOT
from demandops.staterepo import reader
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader

_LISTS = {"start": "started", "change": "changed", "stop": "stopped"}
_SIGN_OF = {"added": "+", "changed": "~", "removed": "-"}


@click.command()
@click.argument("before", metavar="A")
@click.argument("after", metavar="B")
@state_repo_option
@output_option
def diff(before: str, after: str, state_repo: str, output: str) -> None:
    """Show what differs between two commits, in bookkeeping and in what runs.

    A and B are commits, or times: 2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h.
    """
    with reader.opened(state_repo) as repo:
        old, new = (_loaded(repo, revision) for revision in (before, after))
        releases, others = _releases(repo, old, new)
    books = [bookkeeping(one.state.ledger, one.state.config) for one in (old, new)]
    entries = difference(*books)
    if output == "json":
        was, now = map(asdict, books)
        print_json(
            {
                kind: _entries(
                    [one for one in entries if f"{one.kind}s" == kind], was[kind], now[kind]
                )
                for kind in ("services", "connections")
            }
            | {
                "releases": {
                    word: [_row(one) for one in releases if one.change == change]
                    for change, word in _LISTS.items()
                },
                "other_files": others,
            }
        )
        return
    out = console()
    for line in list(_entry_lines(entries)) or ["no difference in bookkeeping"]:
        out.print(line)
    for line in list(_release_lines(releases, others)) or ["no difference in what runs"]:
        out.print(line)


def _loaded(repo: Reader, revision: str) -> Snapshot:
    with progress("reading the ledger") as tell:
        snapshot = repo.last_valid_snapshot(repo.commit(revision), tell)
    warn_of(repo.problems_of(snapshot))
    return snapshot


def _releases(
    repo: Reader, old: Snapshot, new: Snapshot
) -> tuple[list[ReleaseDifference], list[str]]:
    before, after = repo.file_reader(str(old.commit)), repo.file_reader(str(new.commit))
    differing = repo.changed_files(str(old.commit), str(new.commit), CLUSTERS_ROOT)
    files = {path: (before(path), after(path)) for path in differing}
    sides = [(one.state.ledger, one.state.config) for one in (old, new)]
    return compare(sides[0], sides[1], files)


def _row(release: ReleaseDifference) -> dict[str, Any]:
    return {
        "name": release.name,
        "what": release.what,
        "file": release.path,
        "details": list(release.details),
    }


def _release_lines(releases: Iterable[ReleaseDifference], others: Iterable[str]) -> Iterator[str]:
    for release in releases:
        yield f"{SIGNS[release.change]} release {release.name} ({release.what})"
        yield from (f"    {detail}" for detail in release.details)
    yield from (f"~ file {path}" for path in others)


def _entries(
    changes: Iterable[EntryChange], old: dict[str, Any], new: dict[str, Any]
) -> dict[str, Any]:
    """Return the entries of one kind that differ, whole, as they were and as they are."""
    found: dict[str, dict[str, Any]] = {"added": {}, "removed": {}, "changed": {}}
    for one in changes:
        sides = {"before": old.get(one.name), "after": new.get(one.name)}
        whole = {"added": sides["after"], "removed": sides["before"], "changed": sides}
        found[one.change][one.name] = _plain(whole[one.change])
    return found


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _entry_lines(entries: Iterable[EntryChange]) -> Iterator[str]:
    for one in entries:
        who = "" if one.change == "changed" else f" for {', '.join(one.requesters)}"
        yield f"{_SIGN_OF[one.change]} {one.kind} {one.name}{who}"
        yield from (f"    - {fact}" for fact in one.lost)
        yield from (f"    + {fact}" for fact in one.gained)
