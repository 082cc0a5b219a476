"""The bookkeeping of both actions in a hundred lines, written only from docs/demand.md.

It imports nothing of the program and shares no idea with it, so a mistake stays unnoticed only if
both make it. Where the docs leave something open, a comment says what this model does.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass

from tests.model.listed import Claim, Goal, Subject, Topic, World, inadmissible, items

Demand = tuple[str, tuple[str, ...]]
"""A request id and its sorted requesters; or the id of a ``Demand``, and nobody."""
Key = tuple[Subject, Demand]


class _Refused(Exception):
    pass


@dataclass(frozen=True)
class Result:
    """``not_held`` has what a shutdown lists in vain, with None for all of a subject."""

    outcome: str
    reason: str = ""
    not_held: tuple[tuple[str, Topic | None, tuple[str, ...]], ...] = ()
    touched: frozenset[Key] = frozenset()


class Books:
    def __init__(self, world: World) -> None:
        self.world, self.claims = world, dict[Key, Claim]()

    def take(self, goal: Goal) -> Result:
        """Book or release a goal as a whole, or refuse it as a whole."""
        before, not_held = deepcopy(self.claims), []
        gives_up = goal.get("shutdown") or goal.get("operation") == "release"
        try:
            for problem in inadmissible(goal, self.world):
                raise _Refused(problem)
            if goal.get("kind") == "Demand":
                self._own(goal)
            elif gives_up:
                not_held = list(self._shut_down(goal))
            else:
                for subject, claim in items(goal, self.world):
                    self._add((subject, (goal.get("id", ""), claim.who)), claim)
        except _Refused as refusal:
            self.claims = before
            return Result("refused", str(refusal))
        keys = {*before, *self.claims}
        touched = frozenset(key for key in keys if before.get(key) != self.claims.get(key))
        outcome = "released" if gives_up else "booked" if touched else "unchanged"
        return Result(outcome, "", tuple(not_held), touched)

    def _add(self, key: Key, claim: Claim) -> None:
        others = (other for (subject, _), other in self.claims.items() if subject == key[0])
        if any(map(claim.contradicts, others)):
            raise _Refused("it contradicts a claim on the same subject")
        mine = self.claims.setdefault(key, claim)
        mine.topics = {**mine.topics, **claim.topics}
        mine.broker = mine.broker or claim.broker

    def _shut_down(self, goal: Goal) -> Iterator[tuple[str, Topic | None, tuple[str, ...]]]:
        taken = dict[Key, set[Topic]]()
        for subject, listed in items(goal, self.world):
            key = subject, (goal.get("id", ""), listed.who)
            claim = self.claims.get(key)
            if claim is None or not listed.means(claim):
                yield subject[1], None, listed.who
                continue
            named = {*(listed.topics or claim.topics)}
            # what the goal lists twice is held until the whole goal is carried out
            taken.setdefault(key, set()).update(named & claim.topics.keys())
            yield from ((subject[1], topic, listed.who) for topic in named - claim.topics.keys())
        if not any(taken.values()):
            raise _Refused("nothing that it lists is held")
        for key, gone in taken.items():
            topics = self.claims[key].topics
            self.claims[key].topics = {one: to for one, to in topics.items() if one not in gone}
            if not self.claims[key].topics:
                del self.claims[key]

    def _own(self, goal: Goal) -> None:
        demand, who = (goal["demand"], ()), tuple(sorted({*goal["requesters"]}))
        operation = goal.get("operation", "put")
        held = {key: claim for key, claim in self.claims.items() if key[1] == demand}
        if any(claim.who != who for claim in held.values()):
            raise _Refused("it is a demand of others")
        if operation != "put" and not held:
            raise _Refused("it holds nothing")
        for key in held if operation != "renew" else ():
            del self.claims[key]
        for subject, claim in items(goal, self.world):
            self._add((subject, demand), claim)
