"""The releases that differ between two commits, and the facts in which they differ.

The files decide whether a release differs, because the clusters follow the files. The plans of both
commits describe the difference.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from demandops.errors import Refused
from demandops.ledger.world import World
from demandops.plan.planner import plan
from demandops.plan.release import Release
from demandops.plan.release_keys import all_keys
from demandops.render.changes.changeset import CHANGE_ORDER, Change, describe_change

_MOST_LINES = 12

Sides = tuple[str | None, str | None]
"""The text of a file before and after; ``None`` if it does not exist."""


@dataclass(frozen=True, slots=True)
class ReleaseDifference:
    """A release that started, stopped or changed; ``path`` is its file, if possible the new one."""

    name: str
    change: Change
    description: str
    path: str
    details: tuple[str, ...]


def compare(
    before: World, after: World, files: Mapping[str, Sides]
) -> tuple[list[ReleaseDifference], list[str]]:
    """Return the releases that differ, and the differing files that are not of a release.

    Args:
        before, after: the world of each commit.
        files: all generated files that differ.
    """
    old, new = _by_name(before), _by_name(after)
    by_release: dict[str, dict[str, Sides]] = {}
    others = []
    for path, sides in sorted(files.items()):
        name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
        if name in old or name in new:
            by_release.setdefault(name, {})[path] = sides
        else:
            others.append(path)
    differences = [
        _difference(name, old.get(name), new.get(name), changed)
        for name, changed in by_release.items()
    ]
    differences.sort(key=lambda release: (CHANGE_ORDER.index(release.change), release.name))
    return differences, others


def _by_name(world: World) -> dict[str, Release]:
    releases = {}
    for key in all_keys(world):
        try:
            release = plan(world, key)
        except Refused:  # a person's change that cannot be carried out
            continue
        if release is not None:
            releases[release.name] = release
    return releases


def _difference(
    name: str, old: Release | None, new: Release | None, files: Mapping[str, Sides]
) -> ReleaseDifference:
    old_path = next((path for path, sides in files.items() if sides[0] is not None), None)
    new_path = next((path for path, sides in files.items() if sides[1] is not None), None)
    change: Change = "start" if old_path is None else "stop" if new_path is None else "change"
    planned = describe_change(old, new, old_path is not None)
    details = planned.details if change == "change" and planned.change == "change" else ()
    if old_path and new_path and old_path != new_path:
        details = (f"- {old_path}", f"+ {new_path}", *details)
    if change == "change" and not details and new_path:
        details = tuple(_lines(*files[new_path]))
    path = new_path or old_path or ""
    return ReleaseDifference(name, change, planned.description, path, details)


def _lines(before: str | None, after: str | None) -> Iterator[str]:
    """Yield the lines of a file that differ, for a change that no fact of the plan describes."""
    lines = difflib.unified_diff((before or "").split("\n"), (after or "").split("\n"), n=0)
    changed = [line for line in lines if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    yield from (f"{line[0]} {line[1:].strip()}" for line in changed[:_MOST_LINES])
    if len(changed) > _MOST_LINES:
        yield f"… and {len(changed) - _MOST_LINES} more lines"
