"""The queue of demands: requesters take turns, and related demands keep their order.

A demand counts only for its first requester. If another queued demand must stay ahead of the demand
whose turn it is, the queue returns the other demand first.

- Demands that share an application, a connection or a demand id keep their order.
- Goals of the reference's action that share a requester keep their order. For example, of two equal
  shutdowns, the second has an effect only if a join came between them.
- A rollback or a decommission may touch any subject, so it overtakes no demand, and no demand
  overtakes it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from demandops.service.ticket import Ticket

# A goal with one of these fields touches only the subjects that it lists; one without any of them,
# such as a rollback, may touch any subject.
_ORDINARY = {"apps", "applications", "connections", "demand", "shutdown"}


@dataclass(eq=False)
class _Queued:
    number: int  # the order of arrival
    ticket: Ticket
    subjects: frozenset[tuple[str, str]] | None  # None: any
    # A removal only marks the demand, because a search in each deque would be slow; `_next_in`
    # drops those that have left.
    has_left: bool = False


class FairQueue:
    """A queue of demands; not thread-safe.

    With ``in_order``, demands leave in the order of their arrival, and requesters take no turns.
    """

    def __init__(self, *, in_order: bool = False) -> None:
        self._in_order = in_order
        self._queued: dict[Ticket, _Queued] = {}
        self._lanes: dict[str, deque[_Queued]] = {}
        self._subjects: dict[tuple[str, str], deque[_Queued]] = {}
        self._barriers: deque[_Queued] = deque()
        self._arrived = 0

    def __len__(self) -> int:
        return len(self._queued)

    def append(self, ticket: Ticket) -> None:
        self._arrived += 1
        queued = _Queued(self._arrived, ticket, subjects_of(ticket.goal))
        self._queued[ticket] = queued
        self._lanes.setdefault(self._lane(ticket), deque()).append(queued)
        for subject in queued.subjects or ():
            self._subjects.setdefault(subject, deque()).append(queued)
        if queued.subjects is None:
            self._barriers.append(queued)

    def put_back(self, tickets: Sequence[Ticket], served: Iterable[Ticket] = ()) -> None:
        """Put demands back, in the order in which they left, each before others of its requester.

        The requesters of these demands get the next turns. But a requester of ``served``, demands
        that left with them and do not come back, had its turn and comes after all others.
        """
        first = min((queued.number for queued in self._queued.values()), default=1) - len(tickets)
        again = {
            ticket: _Queued(number, ticket, subjects_of(ticket.goal))
            for number, ticket in enumerate(tickets, start=first)
        }
        lanes = dict.fromkeys(map(self._lane, tickets))
        self._lanes = {name: self._lanes.pop(name, deque()) for name in lanes} | self._lanes
        for name in dict.fromkeys(map(self._lane, served)):
            if name in self._lanes:
                self._lanes[name] = self._lanes.pop(name)
        for queued in reversed(again.values()):
            self._lanes[self._lane(queued.ticket)].appendleft(queued)
            for subject in queued.subjects or ():
                self._subjects.setdefault(subject, deque()).appendleft(queued)
            if queued.subjects is None:
                self._barriers.appendleft(queued)
        self._queued = again | self._queued

    def remove(self, tickets: Collection[Ticket]) -> None:
        """Remove those of the demands that are in the queue."""
        for ticket in tickets:
            queued = self._queued.pop(ticket, None)
            if queued is not None:
                queued.has_left = True

    def popleft(self) -> Ticket:
        """Remove and return the next demand; the queue must not be empty."""
        while True:
            requester = next(iter(self._lanes))
            lane = self._lanes.pop(requester)
            first = _next_in(lane)
            if first is not None:
                self._lanes[requester] = lane  # at the end, so that the other requesters come first
                break
        # whoever has the turn, related demands leave in the order in which they came
        while (predecessor := self._predecessor(first)) is not None:
            first = predecessor
        self.remove([first.ticket])
        for subject in first.subjects or ():  # many ids come only once; keep none of them
            if _next_in(self._subjects[subject]) is None:
                del self._subjects[subject]
        return first.ticket

    def _lane(self, ticket: Ticket) -> str:
        return "" if self._in_order else requester_of(ticket.goal)

    def _predecessor(self, queued: _Queued) -> _Queued | None:
        barrier = _next_in(self._barriers)
        if barrier is not None and barrier.number < queued.number:
            return barrier
        if queued.subjects is None:
            oldest = next(iter(self._queued.values()))
            return oldest if oldest is not queued else None
        for subject in queued.subjects:
            first = _next_in(self._subjects[subject])
            if first is not None and first is not queued:
                return first
        return None


def _next_in(lane: deque[_Queued]) -> _Queued | None:
    while lane and lane[0].has_left:
        lane.popleft()
    return lane[0] if lane else None


def requester_of(goal: Any) -> str:  # noqa: ANN401 - plain data
    """Return the first requester of a goal, even of an invalid one; empty if it names none."""
    fields = goal if isinstance(goal, dict) else {}
    own = fields.get("requesters")
    names = own if isinstance(own, list) else _requesters(fields)
    return next((name for name in names if isinstance(name, str)), "")


def _requesters(goal: dict[str, Any]) -> Iterator[Any]:
    """Yield the requesters of a goal of the reference's action."""
    bodies = (app.get("object_detection_fusion_app") for app in _items(goal, "apps"))
    for item in (*bodies, *_items(goal, "connections")):
        names = item.get("requester_ids") if isinstance(item, dict) else None
        yield from names if isinstance(names, list) else ()


def subjects_of(goal: Any) -> frozenset[tuple[str, str]] | None:  # noqa: ANN401 - plain data
    """Return the subjects that a goal, even an invalid one, touches; None means any subject."""
    if not isinstance(goal, dict) or _ORDINARY.isdisjoint(goal):
        return None
    headers = (app.get("header") for app in _items(goal, "apps"))
    subjects = [("demand", goal.get("demand"))]
    subjects += [("application", each.get("id")) for each in headers if isinstance(each, dict)]
    for kind in ("application", "connection"):
        subjects += [(kind, item.get("id")) for item in _items(goal, f"{kind}s")]
    subjects += [("requester", name) for name in _requesters(goal)]
    return frozenset((kind, id) for kind, id in subjects if isinstance(id, str))


def _items(fields: dict[str, Any], name: str) -> Iterator[dict[str, Any]]:
    items = fields.get(name)
    return (item for item in (items if isinstance(items, list) else ()) if isinstance(item, dict))
