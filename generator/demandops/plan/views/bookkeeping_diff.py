"""The differences between two bookkeepings, entry by entry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from demandops.plan.views.bookkeeping import Bookkeeping, ConnectionEntry, ServiceEntry


@dataclass(frozen=True, slots=True)
class EntryChange:
    """One service or connection that was added, changed or removed.

    ``requesters`` are the current ones, or the last ones if it was removed. ``lost`` and ``gained``
    list what changed.
    """

    kind: Literal["service", "connection"]
    name: str
    change: Literal["added", "changed", "removed"]
    requesters: tuple[str, ...]
    lost: tuple[str, ...] = ()
    gained: tuple[str, ...] = ()


def bookkeeping_changes(old: Bookkeeping, new: Bookkeeping) -> tuple[EntryChange, ...]:
    """Return every entry that differs: services, then connections, each sorted by name."""
    return (
        *_changes("service", dict(old.services), dict(new.services)),
        *_changes("connection", dict(old.connections), dict(new.connections)),
    )


_Entry = ServiceEntry | ConnectionEntry


def _changes(
    kind: Literal["service", "connection"], old: dict[str, _Entry], new: dict[str, _Entry]
) -> Iterator[EntryChange]:
    for name in sorted({*old, *new}):
        before, after = old.get(name), new.get(name)
        if after is None and before is not None:
            yield EntryChange(kind, name, "removed", before.requesters)
        elif after is not None and before is None:
            yield EntryChange(kind, name, "added", after.requesters)
        elif before is not None and after is not None and before != after:
            had, has = list(_facts(before)), list(_facts(after))
            lost = tuple(fact for fact in had if fact not in has)
            gained = tuple(fact for fact in has if fact not in had)
            yield EntryChange(kind, name, "changed", after.requesters, lost, gained)


def _facts(entry: _Entry) -> Iterator[str]:
    yield from (f"requester {requester}" for requester in entry.requesters)
    if isinstance(entry, ConnectionEntry):
        yield f"from {entry.source} to {entry.target}"
        yield from (f"topic {topic}" for topic in entry.topics)
        return
    yield f"on {entry.node}"
    yield from (f"for {application}" for application in entry.applications)
    for role, topics in sorted(entry.inputs.items()):
        yield from (f"{role} {topic}" for topic in topics)
