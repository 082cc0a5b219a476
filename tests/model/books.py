"""The bookkeeping of both actions in 250 lines, written only from docs/demand.md.

It imports nothing of the program and shares no idea with it, so a mistake stays unnoticed only if
both make it. Where the docs leave something open, a comment says what this model does. Its
subclasses add places, instances, and what runs. Times are seconds.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from tests.model.listed import (
    MQTT,
    Claim,
    Goal,
    Route,
    Subject,
    Topic,
    World,
    cannot_carry,
    inadmissible,
    items,
)

Demand = tuple[str, tuple[str, ...]]
"""A request id and its sorted requesters; or the id of a ``Demand``, and nobody."""
Key = tuple[Subject, Demand]


Held = tuple[str, Topic | None, tuple[str, ...]]
"""What a shutdown lists in vain: a subject's id, a topic (None for all), and the requesters."""


class Refused(Exception):
    pass


@dataclass(frozen=True)
class Result:
    outcome: str
    reason: str = ""
    not_held: tuple[Held, ...] = ()
    touched: frozenset[Key] = frozenset()


@dataclass
class Books:
    world: World
    claims: dict[Key, Claim] = field(default_factory=dict)
    not_held: list[Held] = field(default_factory=list)

    def take(self, goal: Goal, now: float = 0, received: str = "") -> Result:
        """Book or release a goal as a whole, or refuse it as a whole.

        ``unchanged`` may be a renewal, which makes a commit only if the recorded end of a lease
        changes.
        """
        saved = pickle.dumps(self.__dict__)  # copying it takes ten times longer
        self.not_held = []
        try:
            outcome = self._taken(goal, now, received)
        except Refused as refusal:
            self.__dict__.update(pickle.loads(saved))  # noqa: S301 - bytes of this model
            return Result("refused", str(refusal))
        before: dict[Key, Claim] = pickle.loads(saved)["claims"]  # noqa: S301
        keys = {*before, *self.claims}
        touched = frozenset(key for key in keys if before.get(key) != self.claims.get(key))
        if outcome == "booked" and not touched:
            outcome = "unchanged"
        return Result(outcome, "", tuple(self.not_held), touched)

    def _taken(self, goal: Goal, now: float, received: str) -> str:
        """Take a goal that was received at a time by the wall clock; raise ``Refused`` if not."""
        gives_up = goal.get("shutdown") or goal.get("operation") == "release"
        for problem in inadmissible(goal, self.world):
            raise Refused(problem)
        if goal.get("kind") == "Demand":
            self._own(goal, now)
        elif gives_up:
            self.not_held = list(self._shut_down(goal))
        else:
            self._join(goal)
        return "released" if gives_up else "booked"

    def of(self, demand: str) -> dict[Subject, Claim]:
        return {key[0]: claim for key, claim in self.claims.items() if key[1] == (demand, ())}

    def on(self, kind: str) -> list[tuple[str, Claim]]:
        """Return the claims on subjects of a kind, with the subjects' ids."""
        return [(key[0][1], claim) for key, claim in self.claims.items() if key[0][0] == kind]

    def drop(self, keys: Iterable[Key]) -> None:
        for key in keys:
            del self.claims[key]

    def _join(self, goal: Goal) -> None:
        listed = [
            (subject, claim, goal.get("id", "")) for subject, claim in items(goal, self.world)
        ]
        brought: set[tuple[str, ...]] = {
            route[2:] for _, claim, _ in listed for route in claim.routes()
        }
        for subject, claim, id in listed:
            self._add((subject, (id, claim.who)), claim)
        for subject, claim, id in listed:
            if subject[0] == "application":
                self._imply(claim, (id, claim.who), brought)

    def _add(self, key: Key, claim: Claim, former: dict[Key, Claim] | None = None) -> None:
        """Add what an item lists; each topic of a connection goes to the one that carries it."""
        if key[0][0] == "application":
            self._unite(key, claim)
        for route, topic in claim.routes().items() if key[0][0] == "connection" else ():
            carrier = self._carrier(route, key[1], former or {}) or key[0]
            one = Claim(claim.fixed, claim.broker, {topic: claim.topics[topic]}, claim.who)
            one.listed = {topic: key[0][1]}
            self._carry((carrier, key[1]), one, is_new=carrier == key[0])

    def _carrier(self, route: Route, demand: Demand, former: dict[Key, Claim]) -> Subject | None:
        found = {
            key: claim
            for key, claim in {**former, **self.claims}.items()
            if key[0][0] == "connection" and route in claim.routes()
        }
        own = [key[0] for key in found if key[1] == demand]
        return min(own or [key[0] for key in found], default=None)

    def _carry(self, key: Key, one: Claim, *, is_new: bool) -> None:
        standing = [claim for (subject, _), claim in self.claims.items() if subject == key[0]]
        if standing:
            broker = next((claim.broker for claim in standing if claim.broker), "")
            ends = {name: one.fixed[name] for name in ("source", "target")}
            one.fixed, one.broker = {**standing[0].fixed, **ends}, broker
        if is_new and (problem := cannot_carry(one, self.world)):
            raise Refused(problem)
        self._unite(key, one)

    def _unite(self, key: Key, claim: Claim) -> None:
        others = (other for (subject, _), other in self.claims.items() if subject == key[0])
        if any(map(claim.contradicts, others)):
            raise Refused("it contradicts a claim on the same subject")
        mine = self.claims.setdefault(key, claim)
        mine.topics = {**mine.topics, **claim.topics}
        # what a goal lists stays listed under the first id
        kept = {topic: id for topic, id in mine.listed.items() if id is not None}
        mine.listed = {**mine.listed, **claim.listed, **kept}
        mine.broker = mine.broker or claim.broker

    def _imply(self, app: Claim, demand: Demand, brought: set[tuple[str, ...]]) -> None:
        """Add what an application reads from another node, and no goal of the demand lists."""
        node = app.fixed["node"]
        for _, topic, source in app.topics:
            if source == node or (node, topic) in brought:
                continue
            bringing = [
                (key[1] != demand, route[1] != topic, key[0], route, claim.listed[one])
                for key, claim in self.claims.items()
                if key[0][0] == "connection"
                for route, one in claim.routes().items()
                if route[2:] == (node, topic)
                and (route[0] == source or (key[1] == demand and claim.listed[one] is not None))
            ]
            first = min(bringing, default=None, key=lambda each: each[:3])
            if first and not first[0] and first[4] is not None:
                continue
            name = first[3][1] if first else topic
            fixed = {"type": MQTT, "source": source, "target": node}
            one = Claim(fixed, "", {(name,): topic}, demand[1], {(name,): None})
            derived = "connection", f"derived/{source}/{node}{name}"
            carrier = self._carrier((source, name, node, topic), demand, {})
            self._carry((carrier or derived, demand), one, is_new=False)

    def _shut_down(self, goal: Goal) -> Iterator[Held]:
        taken = dict[Key, set[Topic]]()
        for subject, listed in items(goal, self.world):
            demand = goal.get("id", ""), listed.who
            held = list(self._held(subject, listed, demand))
            # what the goal lists twice is held until the whole goal is carried out
            for _, key, topic in held:
                taken.setdefault(key, set()).add(topic)
            found = {topic for topic, _, _ in held}
            claim = self.claims.get((subject, demand))
            if claim and not listed.means(claim):
                claim = None
            if not listed.topics or (not found and claim is None):
                yield from [(subject[1], None, listed.who)] * (not found)
                continue
            yield from ((subject[1], topic, listed.who) for topic in {*listed.topics} - found)
        if not taken:
            raise Refused("nothing that it lists is held")
        for key, gone in taken.items():
            self._take(key, gone)
        for demand in {demand for (subject, demand) in taken if subject[0] == "application"}:
            self._end_implied(demand)

    def _held(
        self, subject: Subject, listed: Claim, demand: Demand
    ) -> Iterator[tuple[Topic, Key, Topic]]:
        """Yield (topic as listed, claim, topic there) for what the demand holds of an item."""
        for key, claim in self.claims.items():
            if key[1] != demand or key[0][0] != subject[0]:
                continue
            if subject[0] == "application":
                topics = listed.topics or claim.topics
                if key[0] == subject and listed.means(claim):
                    # a shutdown may leave out a topic's source too
                    pairs = ((one, own) for one in topics for own in claim.topics)
                    yield from (
                        (one, key, own)
                        for one, own in pairs
                        if one[:2] == own[:2] and one[2] in ("", own[2])
                    )
                continue
            if not listed.means(claim):
                continue
            for topic, id in claim.listed.items() if not listed.topics else ():
                if id == subject[1]:
                    yield topic, key, topic
            for topic, target in listed.topics.items():
                if claim.topics.get(topic) == target or (
                    key[0] == subject and topic in claim.topics
                ):
                    yield topic, key, topic

    def _take(self, key: Key, gone: set[Topic]) -> None:
        claim = self.claims[key]
        claim.topics = {one: to for one, to in claim.topics.items() if one not in gone}
        claim.listed = {one: id for one, id in claim.listed.items() if one not in gone}
        if not claim.topics:
            del self.claims[key]

    def _end_implied(self, demand: Demand) -> None:
        needed = {
            (source, claim.fixed["node"], topic)
            for (subject, of), claim in self.claims.items()
            if subject[0] == "application" and of == demand
            for _, topic, source in claim.topics
        }
        for key, claim in list(self.claims.items()):
            if key[0][0] == "connection" and key[1] == demand:
                idle = {
                    one
                    for route, one in claim.routes().items()
                    if claim.listed[one] is None and (route[0], *route[2:]) not in needed
                }
                self._take(key, idle)

    def _own(self, goal: Goal, now: float) -> None:
        demand, who = (goal["demand"], ()), tuple(sorted({*goal["requesters"]}))
        operation = goal.get("operation", "put")
        held = {key: claim for key, claim in self.claims.items() if key[1] == demand}
        if any(claim.who != who for claim in held.values()):
            raise Refused("it is a demand of others")
        if operation != "put" and not held:
            raise Refused("it holds nothing")
        if operation == "renew":
            for claim in held.values():
                claim.grant(claim.lease, now, claim)
            return
        self.drop(held)
        if operation == "release":
            return
        for subject, claim in items(goal, self.world):
            self._add((subject, demand), claim, held)
        for subject, claim in self.of(goal["demand"]).items():
            claim.grant(goal.get("lease"), now, held.get((subject, demand)))
