"""``demandops diff``: the differences between two commits, in bookkeeping and releases."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import click

from demandops.cli.json_output import (
    entry_change_data,
    output_option,
    print_json,
    release_change_data,
)
from demandops.cli.output import SIGNS, console, progress, state_repo_option, warn_of
from demandops.plan.views.bookkeeping import EntryChange, bookkeeping, bookkeeping_changes
from demandops.render.changes.changeset import ReleaseChange
from demandops.render.changes.merge_preview import MergePreview, planned_releases, preview
from demandops.render.gitops.paths import CLUSTERS_ROOT
from demandops.staterepo import reader
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader


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
        found = _compare(repo, old, new)
    entries = bookkeeping_changes(*(bookkeeping(each.state) for each in (old, new)))
    if output == "json":
        print_json(
            {
                "bookkeeping": [entry_change_data(each) for each in entries],
                "releases": [release_change_data(each) for each in found.releases],
                "other_files": list(found.other_files),
            }
        )
        return
    out = console()
    for line in list(entry_lines(entries)) or ["no difference in bookkeeping"]:
        out.print(line)
    files = [f"~ file {path}" for path in found.other_files]
    lines = [*release_lines(found.releases, "release "), *files]
    for line in lines or ["no difference in releases"]:
        out.print(line)


def _loaded(repo: Reader, revision: str) -> Snapshot:
    with progress("reading the ledger") as report:
        snapshot = repo.last_valid_snapshot(repo.commit(revision), report)
    warn_of(repo.problems_of(snapshot))
    return snapshot


def _compare(repo: Reader, old: Snapshot, new: Snapshot) -> MergePreview:
    sides = [(repo.file_reader(str(each.commit)), each.state) for each in (old, new)]
    differing = repo.changed_files(str(old.commit), str(new.commit), CLUSTERS_ROOT)
    texts = [
        {path: text for path in differing if (text := read(path)) is not None} for read, _ in sides
    ]
    releases = [planned_releases(state) for _, state in sides]
    return preview(releases[0], releases[1], texts[0], texts[1])


def release_lines(releases: Iterable[ReleaseChange], word: str = "") -> Iterator[str]:
    """Yield releases that differ, as text."""
    for release in releases:
        yield f"{SIGNS[release.change]} {word}{release.name} ({release.description})"
        yield from (f"    {detail}" for detail in release.details)


def entry_lines(entries: Iterable[EntryChange]) -> Iterator[str]:
    """Yield entries of the bookkeeping that differ, as text."""
    for entry in entries:
        who = "" if entry.change == "changed" else f" for {', '.join(entry.requesters)}"
        yield f"{SIGNS[entry.change]} {entry.kind} {entry.name}{who}"
        yield from (f"    - {fact}" for fact in entry.lost)
        yield from (f"    + {fact}" for fact in entry.gained)
