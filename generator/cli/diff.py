"""``demandops diff``: what differs between two commits, in bookkeeping and in what runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any

import click

from generator.cli.output import (
    SIGNS,
    console,
    output_option,
    print_json,
    progress,
    state_repo_option,
    warn_of,
)
from generator.plan.bookkeeping import bookkeeping
from generator.render.comparison import ReleaseDifference, compare
from generator.render.paths import CLUSTERS_ROOT
from generator.staterepo import reader
from generator.staterepo.reader import Reader
from generator.staterepo.snapshot import Snapshot

_LISTS = {"start": "started", "change": "changed", "stop": "stopped"}


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
    was, now = (asdict(bookkeeping(s.state.ledger, s.state.catalog)) for s in (old, new))
    data = {
        "services": _changes(was["services"], now["services"]),
        "connections": _changes(was["connections"], now["connections"]),
    }
    if output == "json":
        print_json(
            data
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
    for line in list(_lines(data)) or ["no difference in bookkeeping"]:
        out.print(line)
    for line in list(_release_lines(releases, others)) or ["no difference in what runs"]:
        out.print(line)


def _loaded(repo: Reader, revision: str) -> Snapshot:
    with progress("reading the ledger") as tell:
        snapshot = repo.last_valid(repo.commit(revision), tell)
    warn_of(snapshot.problems)
    return snapshot


def _releases(
    repo: Reader, old: Snapshot, new: Snapshot
) -> tuple[list[ReleaseDifference], list[str]]:
    before, after = repo.file_reader(str(old.commit)), repo.file_reader(str(new.commit))
    differing = repo.differing(str(old.commit), str(new.commit), CLUSTERS_ROOT)
    files = {path: (before(path), after(path)) for path in differing}
    sides = [(one.state.ledger, one.state.catalog) for one in (old, new)]
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


def _changes(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    return {
        "added": {name: _plain(new[name]) for name in sorted(new.keys() - old.keys())},
        "removed": {name: _plain(old[name]) for name in sorted(old.keys() - new.keys())},
        "changed": {
            name: {"before": _plain(old[name]), "after": _plain(new[name])}
            for name in sorted(old.keys() & new.keys())
            if old[name] != new[name]
        },
    }


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _lines(data: dict[str, Any]) -> Iterator[str]:
    for kind in ("services", "connections"):
        word = kind[:-1]
        for name, entry in data[kind]["added"].items():
            yield f"+ {word} {name} for {', '.join(entry['requesters'])}"
        for name, sides in data[kind]["changed"].items():
            yield f"~ {word} {name}"
            before, after = set(_facts(sides["before"])), set(_facts(sides["after"]))
            yield from (f"    - {fact}" for fact in sorted(before - after))
            yield from (f"    + {fact}" for fact in sorted(after - before))
        for name, entry in data[kind]["removed"].items():
            yield f"- {word} {name} for {', '.join(entry['requesters'])}"


def _facts(entry: dict[str, Any]) -> Iterable[str]:
    for requester in entry["requesters"]:
        yield f"requester {requester}"
    for role, topics in entry.get("inputs", {}).items():
        yield from (f"{role} {topic}" for topic in topics)
    yield from (f"topic {topic}" for topic in entry.get("topics", ()))
    for key in ("node", "source", "target"):
        if key in entry:
            yield f"{key} {entry[key]}"
