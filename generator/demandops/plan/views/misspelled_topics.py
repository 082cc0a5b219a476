"""Warnings about misspelled topics, which differ by a letter from a known topic of the node.

Nobody lists all topics of a node, so an unknown topic alone is no mistake. Names that differ in a
digit, or in a letter of a short word (``lidar_fl``, ``lidar_fr``), count as two correct topics.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import takewhile

from demandops.connections.connection import Connection
from demandops.demand.application import Application
from demandops.demand.demand_request import DemandRequest
from demandops.errors import Fault, fault
from demandops.ledger import claim_file
from demandops.ledger.world import World

_WORD = re.compile(r"[A-Za-z]+")
# In words with fewer letters, one other letter often makes another correct word.
_SHORT = 4


def notes(request: DemandRequest, world: World) -> Iterator[str]:
    if request.adds_claims:
        known = _KnownTopics(world)
        for item in request.demanded:
            yield from known.notes_on(item.held)


def warnings(world: World) -> Iterator[Fault]:
    known = _KnownTopics(world)
    for claim in sorted(world.ledger, key=lambda claim: claim_file.path_of(claim.key)):
        for note in known.notes_on(claim.held):
            yield fault("", note).within(claim_file.path_of(claim.key))


class _KnownTopics:
    """The known topics of each node: those of the inventory, and the booked usual topics."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._listed: dict[str, frozenset[str]] = {}
        self._booked: dict[tuple[str, str], frozenset[str]] = {}
        self._told: set[tuple[str, str]] = set()

    def notes_on(self, held: Application | Connection) -> Iterator[str]:
        """Yield a warning for each misspelled topic that an earlier call did not report."""
        if isinstance(held, Application):
            what = f"application '{held.id}'"
            for role, input in held.all_inputs():
                place = (role, input.source)
                if place not in self._booked:
                    booked = self._world.ledger.usual_topics(*place, excluded="")
                    self._booked[place] = frozenset(booked)
                known = (self._of(input.source), self._booked[place])
                yield from self._notes(what, input.source, input.topic, *known)
            return
        for route in held.topics:
            sender, _ = route.sender_and_receiver(held.source, held.target)
            topic = route.read_topic
            yield from self._notes(f"connection '{held.id}'", sender, topic, self._of(sender))

    def _notes(self, what: str, node: str, topic: str, *known: frozenset[str]) -> Iterator[str]:
        # not united: a demand may list thousands of topics, and all of them may be known
        if (node, topic) in self._told or any(topic in topics for topics in known):
            return
        near = [each for topics in known for each in topics if _is_misspelling(topic, each)]
        if near:
            self._told.add((node, topic))
            yield f"{what}: '{node}' is not known to publish {topic}; did you mean '{min(near)}'?"

    def _of(self, node: str) -> frozenset[str]:
        if node not in self._listed:
            entry = self._world.config.nodes.get(node)
            topics = set[str]()
            if entry:
                topics = {*entry.topics.values(), *entry.types}.union(*entry.bridged.values())
            self._listed[node] = frozenset(topics)
        return self._listed[node]


def _is_misspelling(topic: str, other: str) -> bool:
    """Return whether ``topic`` may be a misspelling of ``other``.

    It is one if both differ only in a word of at least four letters. In this word, ``topic`` must
    have one wrong, missing or additional letter, or two letters in the wrong order.
    """
    if abs(len(topic) - len(other)) > 1:
        return False
    start = _common(topic, other)
    end = _common(topic[start:][::-1], other[start:][::-1])
    written, correct = topic[start : len(topic) - end], other[start : len(other) - end]
    if sorted(written) != sorted(correct) and max(len(written), len(correct)) > 1:
        return False
    if len(written) > len("ab") or not (written + correct).isalpha():
        return False
    word = next(match for match in _WORD.finditer(other + " a") if match.end() >= start)
    return len(word[0]) >= _SHORT and word.start() <= start


def _common(one: str, other: str) -> int:
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(one, other, strict=False)))
