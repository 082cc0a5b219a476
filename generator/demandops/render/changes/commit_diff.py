"""What runs otherwise at one commit than at another: releases, and in which facts they differ.

Goes by the files, for these are what the clusters follow, and by both plans for what they mean.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from demandops.config.config import Config
from demandops.errors import Refused
from demandops.ledger.ledger import Ledger
from demandops.plan.planner import plan
from demandops.plan.release import Release
from demandops.plan.release_keys import all_keys
from demandops.render.changes.changeset import Change, described

_MOST_LINES = 12

Sides = tuple[str | None, str | None]
"""The text of a file before and after; nothing where there was none."""


@dataclass(frozen=True, slots=True)
class ReleaseDifference:
    """One release that started, stopped or changed; ``path`` is its file, the newer one."""

    name: str
    change: Change
    what: str
    path: str
    details: tuple[str, ...]


def compare(
    before: tuple[Ledger, Config], after: tuple[Ledger, Config], files: Mapping[str, Sides]
) -> tuple[list[ReleaseDifference], list[str]]:
    """Return the releases that differ, and the other files that do.

    Args:
        before, after: books and configuration of both commits.
        files: every generated file that differs.
    """
    old, new = _by_name(*before), _by_name(*after)
    moves: dict[str, dict[str, Sides]] = {}
    others = []
    for path, sides in sorted(files.items()):
        name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
        if name in old or name in new:
            moves.setdefault(name, {})[path] = sides
        else:
            others.append(path)
    found = [_difference(name, old.get(name), new.get(name), at) for name, at in moves.items()]
    order = ("start", "change", "stop")
    return sorted(found, key=lambda one: (order.index(one.change), one.name)), others


def _by_name(ledger: Ledger, config: Config) -> dict[str, Release]:
    found = {}
    for key in all_keys(ledger, config):
        try:
            release = plan(ledger, config, key)
        except Refused:  # a person's change that could not be carried out
            continue
        if release is not None:
            found[release.name] = release
    return found


def _difference(
    name: str, old: Release | None, new: Release | None, at: Mapping[str, Sides]
) -> ReleaseDifference:
    was = next((path for path, sides in at.items() if sides[0] is not None), None)
    now = next((path for path, sides in at.items() if sides[1] is not None), None)
    change: Change = "start" if was is None else "stop" if now is None else "change"
    told = described(old, new, was is not None)
    details = told.details if change == "change" and told.change == "change" else ()
    if was and now and was != now:
        details = (f"- {was}", f"+ {now}", *details)
    if change == "change" and not details and now:
        details = tuple(_lines(*at[now]))
    return ReleaseDifference(name, change, told.what, now or was or "", details)


def _lines(before: str | None, after: str | None) -> Iterator[str]:
    """Yield the lines of a file that differ, where no fact of its plan does."""
    lines = difflib.unified_diff((before or "").split("\n"), (after or "").split("\n"), n=0)
    changed = [line for line in lines if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    yield from (f"{line[0]} {line[1:].strip()}" for line in changed[:_MOST_LINES])
    if len(changed) > _MOST_LINES:
        yield f"… and {len(changed) - _MOST_LINES} more lines"
