"""``demandops bookkeeping``: who requests what; ``diff``: that of two commits, and releases."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, replace

import click

from demandops.base.runtime import REAL
from demandops.cli.formats import Table, list_table, output_formats, output_option, show, table_of
from demandops.cli.output import SIGNS, at_option, errors, progress, warn_of_problems
from demandops.cli.target import state_repo_option
from demandops.decide.bookkeeping import EntryChange, as_data, bookkeeping_changes
from demandops.decide.bookkeeping import bookkeeping as derive
from demandops.decide.changeset import MergePreview, ReleaseChange, planned_releases, preview
from demandops.render.gitops import CLUSTERS_ROOT
from demandops.repo import reader
from demandops.repo.history import revisions
from demandops.repo.load.snapshot import Snapshot
from demandops.repo.reader import Reader
from demandops.views.kinds import KINDS, rows_of
from demandops.views.rows import Column
from demandops.views.source import Source
from demandops.views.vocabulary import time_text

# ---- ``demandops bookkeeping`` ----


@click.command()
@state_repo_option
@at_option
@output_formats("text", "wide", "json")
def bookkeeping(state_repo: str, at: str | None, output: str) -> None:
    """Show who requests which service and connection.

    \b
    Examples:
      demandops bookkeeping
      demandops bookkeeping --at 14:03 -o json
    """
    with reader.opened(state_repo) as repo:
        source = Source.read(repo, loaded(repo, at))
    data = as_data(derive(source.state), source.commit)
    capacity = [
        {"node": node, "name": name, **amounts}
        for node, resources in data.get("nodes", {}).items()
        for name, amounts in resources.items()
    ]
    text: list[str | Table] = []
    for name in ("services", "connections"):
        table = list_table(KINDS[name], rows_of(source, name), source.now, wide=True)
        text += [replace(table, title=name.title(), empty="(nothing)", whole=output == "wide"), ""]
    for title, columns, items in (
        ("Suspended", _SUSPENDED, data.get("suspended")),
        ("Capacity", _CAPACITY, capacity),
        ("Waiting for room", _WAITING, data.get("waiting")),
    ):
        if items:
            text += [table_of(columns, items, source.now, title=title), ""]
    show(output, data, [*text, f"at {source.commit}"])


_SUSPENDED = (
    Column("id", "Subject", texts_of=lambda claim, now: "{kind} {id}".format(**claim)),
    Column("demand", "Demand", 2),
    Column("requesters", "Requesters", 1),
    Column("override", "By", 3),
    Column("reason", "Reason", 4),
)
_CAPACITY = (
    Column("node", "Node"),
    Column("name", "Resource"),
    Column("requested", "Requested"),
    Column("capacity", "Capacity"),
)
_WAITING = (
    Column("demand", "Demand"),
    Column("requesters", "Requesters", 2),
    Column("since", "Since", 1, texts_of=lambda demand, now: time_text(demand["since"])),
    Column("priority", "Priority", 1),
)

# ---- ``demandops diff`` ----


@click.command()
@click.argument("before", metavar="A")
@click.argument("after", metavar="[B]", default="", required=False)
@state_repo_option
@output_option
def diff(before: str, after: str, state_repo: str, output: str) -> None:
    """Show the differences between two commits.

    The command compares the bookkeeping, the releases and other files below clusters/. A and B are
    commits, or times like 2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h (two hours ago).
    Without B, it shows what has changed since A.

    \b
    Examples:
      demandops diff 1h
      demandops diff 14:03
      demandops diff main~1 main
    """
    with reader.opened(state_repo) as repo:
        entries, changes = differences(repo, before, after)
    data = {
        "bookkeeping": [asdict(entry) for entry in entries],
        "releases": [asdict(release) for release in changes.releases],
        "other_files": list(changes.other_files),
    }
    bookkeeping_lines = list(entry_lines(entries)) or ["no difference in bookkeeping"]
    lines = [
        *release_lines(changes.releases, "release "),
        *(f"~ file {path}" for path in changes.other_files),
    ]
    show(output, data, [*bookkeeping_lines, *(lines or ["no difference in releases"])])


def differences(
    repo: Reader, before: str, after: str
) -> tuple[tuple[EntryChange, ...], MergePreview]:
    old, new = (loaded(repo, revision) for revision in (before, after))
    commits = str(old.commit), str(new.commit)
    differing = repo.changed_files(*commits, (CLUSTERS_ROOT,))
    texts = []
    for read in map(repo.file_reader, commits):
        read_texts = {path: read(path) for path in differing}
        texts.append({path: text for path, text in read_texts.items() if text is not None})
    entries = bookkeeping_changes(derive(old.state), derive(new.state))
    planned = planned_releases(old.state), planned_releases(new.state)
    return entries, preview(*planned, *texts)


def resolved(repo: Reader, revision: str | None) -> str:
    """Return the id of a commit; if a time names it, say which commit that is."""
    commit, text = repo.commit(revision), revision or ""
    time = revisions.parse_time(text, REAL.now(), end=True)
    if time is not None and not commit.startswith(text.lower()):
        entry = next(repo.log(commit))
        errors.print(
            f"{text} is {time:%Y-%m-%d %H:%M:%S} UTC: commit {commit[:10]} of "
            f"{entry.time:%Y-%m-%d %H:%M:%S} UTC, {entry.summary}"
        )
    return commit


def loaded(repo: Reader, revision: str | None) -> Snapshot:
    commit = resolved(repo, revision)
    with progress("reading the ledger") as report:
        snapshot = repo.snapshot(commit, report)
    warn_of_problems(repo, snapshot)
    return snapshot


def release_lines(releases: Iterable[ReleaseChange], word: str = "") -> Iterator[str]:
    for release in releases:
        yield f"{SIGNS[release.change]} {word}{release.name} ({release.what})"
        yield from (f"    {detail}" for detail in release.details)


def entry_lines(entries: Iterable[EntryChange]) -> Iterator[str]:
    for entry in entries:
        who = "" if entry.change == "changed" else f" for {', '.join(entry.requesters)}"
        yield f"{SIGNS[entry.change]} {entry.kind} {entry.name}{who}"
        yield from (f"    - {fact}" for fact in entry.lost)
        yield from (f"    + {fact}" for fact in entry.gained)
