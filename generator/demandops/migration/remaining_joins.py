"""The joins that no shutdown has undone yet, from the records of the reference's operators.

The bookkeeping file records who holds what, and how often. The versioning file has the requests
that led to these holds. But the operators of connections and detections later change the first
request in this file: they add requesters to it, and remove requesters from it. So the counts always
come from the bookkeeping, and the requests only show which requesters joined together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from demandops.migration.reference_files import Hold, Request


@dataclass(frozen=True, slots=True)
class Join:
    """A join for a resource: each of ``requesters`` holds each of ``topics`` once.

    ``version`` is the version of the resource after the join, or 0 if it is not known. The joins of
    all resources are sorted by ``version``.
    """

    version: int
    requesters: tuple[str, ...]
    topics: tuple[str, ...]


def remaining(book: Counter[Hold], requests: Mapping[int, Request]) -> list[Join]:
    """Return the joins whose holds add up to ``book``, oldest first.

    ``book`` does not tell which requesters joined together, so the newest requests are undone until
    only the holds of the request that created the resource are left. The undone requests are then
    applied again, oldest first, and each join is kept separate.

    Args:
        book: the bookkeeping: how many times each hold counts.
        requests: the requests by version, the oldest first; some may be missing.
    """
    left, undone, created = Counter(book), list[tuple[int, Request]](), 0
    for version, request in reversed([*requests.items()]):
        if request.shutdown:
            left += request.holds()
        elif request.holds() < left:
            left -= request.holds()
        else:
            created = version
            break
        undone.append((version, request))
    joins = [(created, left)]
    for version, request in reversed(undone):
        if request.shutdown:
            _take(joins, request)
        else:
            joins.append((version, request.holds()))
    return [join for version, holds in joins for join in _each_once(version, holds)]


def _take(joins: list[tuple[int, Counter[Hold]]], shutdown: Request) -> None:
    """Remove a shutdown's holds from the joins.

    Each hold is removed from one join that has it. Joins whose requesters are exactly those of the
    shutdown come first, then all others, and older joins before newer ones.
    """
    named = set(shutdown.requester)
    same_first = sorted(joins, key=lambda join: {who for _, who in join[1]} != named)
    for hold in shutdown.holds().elements():
        _, holds = next(join for join in same_first if join[1][hold])
        holds[hold] -= 1
    joins[:] = [(version, +holds) for version, holds in joins if +holds]


def _each_once(version: int, holds: Counter[Hold]) -> Iterator[Join]:
    """Yield joins with these holds.

    A hold that counts twice is in two joins: in a single join or goal, it would count once.
    """
    for count in range(1, max(holds.values(), default=0) + 1):
        topics: dict[str, list[str]] = {}
        for (topic, who), held in holds.items():
            if held >= count:
                topics.setdefault(who, []).append(topic)
        together: dict[tuple[str, ...], list[str]] = {}
        for who, theirs in topics.items():
            together.setdefault(tuple(theirs), []).append(who)
        for theirs_too, requesters in together.items():
            yield Join(version, tuple(requesters), theirs_too)


def replayed(requests: Mapping[int, Request]) -> Counter[Hold]:
    """Return the bookkeeping after these requests.

    The result is right only if the operator did not change the requests after recording them.
    """
    book = Counter[Hold]()
    for request in requests.values():
        if request.shutdown:
            book -= request.holds()
        else:
            book += request.holds()
    return book
