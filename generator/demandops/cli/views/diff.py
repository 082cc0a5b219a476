"""``demandops diff``: the differences between two commits, in bookkeeping and releases."""

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
from demandops.plan.views.bookkeeping_diff import EntryChange, bookkeeping_changes
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
    """Show the differences between two commits.

    They are shown in bookkeeping, releases and other files. A and B are commits, or times like
    2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h.
    """
    with reader.opened(state_repo) as repo:
        old, new = (_loaded(repo, revision) for revision in (before, after))
        releases, others = _releases(repo, old, new)
    sides = [bookkeeping(each.state) for each in (old, new)]
    entries = bookkeeping_changes(*sides)
    if output == "json":
        was, now = map(asdict, sides)
        print_json(
            {
                kind: _entries(
                    [each for each in entries if f"{each.kind}s" == kind], was[kind], now[kind]
                )
                for kind in ("services", "connections")
            }
            | {
                "releases": {
                    word: [_row(each) for each in releases if each.change == change]
                    for change, word in _LISTS.items()
                },
                "other_files": others,
            }
        )
        return
    out = console()
    for line in list(_entry_lines(entries)) or ["no difference in bookkeeping"]:
        out.print(line)
    for line in list(_release_lines(releases, others)) or ["no difference in releases"]:
        out.print(line)


def _loaded(repo: Reader, revision: str) -> Snapshot:
    with progress("reading the ledger") as report:
        snapshot = repo.last_valid_snapshot(repo.commit(revision), report)
    warn_of(repo.problems_of(snapshot))
    return snapshot


def _releases(
    repo: Reader, old: Snapshot, new: Snapshot
) -> tuple[list[ReleaseDifference], list[str]]:
    before, after = repo.file_reader(str(old.commit)), repo.file_reader(str(new.commit))
    differing = repo.changed_files(str(old.commit), str(new.commit), CLUSTERS_ROOT)
    files = {path: (before(path), after(path)) for path in differing}
    return compare(old.state, new.state, files)


def _row(release: ReleaseDifference) -> dict[str, Any]:
    return {
        "name": release.name,
        "what": release.description,
        "file": release.path,
        "details": list(release.details),
    }


def _release_lines(releases: Iterable[ReleaseDifference], others: Iterable[str]) -> Iterator[str]:
    for release in releases:
        yield f"{SIGNS[release.change]} release {release.name} ({release.description})"
        yield from (f"    {detail}" for detail in release.details)
    yield from (f"~ file {path}" for path in others)


def _entries(
    changes: Iterable[EntryChange], old: dict[str, Any], new: dict[str, Any]
) -> dict[str, Any]:
    """Return the whole entries that were added, removed or changed, by name."""
    entries: dict[str, dict[str, Any]] = {"added": {}, "removed": {}, "changed": {}}
    for entry in changes:
        sides = {"before": old.get(entry.name), "after": new.get(entry.name)}
        whole = {"added": sides["after"], "removed": sides["before"], "changed": sides}
        entries[entry.change][entry.name] = _plain(whole[entry.change])
    return entries


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _entry_lines(entries: Iterable[EntryChange]) -> Iterator[str]:
    for entry in entries:
        who = "" if entry.change == "changed" else f" for {', '.join(entry.requesters)}"
        yield f"{_SIGN_OF[entry.change]} {entry.kind} {entry.name}{who}"
        yield from (f"    - {fact}" for fact in entry.lost)
        yield from (f"    + {fact}" for fact in entry.gained)
