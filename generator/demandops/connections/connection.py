"""Connections: demands list them, claims hold them, and clients carry them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Container, Iterator
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import TYPE_CHECKING

from demandops.connections.route import Route, merged_routes
from demandops.subject import Subject, SubjectKind, TopicKey

if TYPE_CHECKING:
    from demandops.connections.connection_type import ConnectionType


@dataclass(frozen=True, slots=True)
class Connection:
    """One connection and the topics that it carries.

    ``type`` is ``None`` if a demand leaves the type open. ``broker`` is empty if the generator
    chooses the broker. The connection of a claim has a type, and its routes are sorted by source
    topic, without duplicates (:meth:`booked`).
    """

    id: str
    type: ConnectionType | None
    source: str
    target: str
    broker: str
    topics: tuple[Route, ...]

    @property
    def subject(self) -> Subject:
        """The subject of a claim on this connection."""
        return Subject(SubjectKind.CONNECTION, self.id)

    @property
    def home(self) -> str:
        """The target, whose access domain sets leases and quotas for the connection."""
        return self.target

    @property
    def nodes(self) -> tuple[str, str]:
        """Both ends. An override's selector may match either of them."""
        return (self.source, self.target)

    @property
    def known_type(self) -> ConnectionType:
        """The type of the connection, for callers that know that a type is chosen."""
        assert self.type is not None, self.id  # noqa: S101
        return self.type

    def route(self, source: str) -> Route | None:
        """Return the route of a source topic, or ``None`` if there is none.

        The routes must be sorted, as the routes of a claim are.
        """
        place = bisect_left(self.topics, source, key=attrgetter("source"))
        found = self.topics[place : place + 1]
        return found[0] if found and found[0].source == source else None

    def needs(self, node: str) -> bool:
        """Return whether a node is an end of the connection or its broker."""
        return node in (self.source, self.target, self.broker)

    def booked(self) -> Connection:
        """Return the connection in the form of a claim: routes sorted, without duplicates."""
        return replace(self, topics=merged_routes(self.topics))

    def extended(self, more: Connection) -> Connection:
        """Return this connection and ``more`` as one connection.

        The result has the topics of both, and the other fields of ``more``. If ``more`` names no
        broker, the result has this connection's broker.
        """
        topics, broker = (*self.topics, *more.topics), more.broker or self.broker
        return replace(more, topics=topics, broker=broker)

    def matches_listed(self, listed: object) -> bool:
        """Return whether a shutdown that lists ``listed`` means this connection.

        The caller has found that both have the same id. An empty source, target or type in
        ``listed`` matches any value.
        """
        return (
            isinstance(listed, Connection)
            and listed.source in ("", self.source)
            and listed.target in ("", self.target)
            and listed.type in (None, self.type)
        )

    def distinguishing_values(self) -> tuple[str, ...]:
        """Return the values by which a shutdown distinguishes connections with the same id."""
        return (self.source, self.target, self.known_type.word)

    def topic_keys(self) -> Iterator[TopicKey]:
        """Yield the key of each topic: a tuple with the topic's name on the source node."""
        for route in self.topics:
            yield (route.source,)

    def listed_topics(self, listed: object) -> Iterator[tuple[str, list[TopicKey]]]:
        """Yield (text, keys) for each topic that a shutdown lists in ``listed``.

        The text names the topic in messages. There is one key, or none if this connection does not
        carry the topic.
        """
        assert isinstance(listed, Connection)  # noqa: S101 - see matches_listed
        known = {*self.topic_keys()}
        for key in listed.topic_keys():
            yield f"topic {key[0]}", [key] if key in known else []

    def without_topics(self, gone: Container[TopicKey]) -> Connection | None:
        """Return the connection without these topics; ``None`` if no topic is left."""
        left = tuple(route for route in self.topics if (route.source,) not in gone)
        return replace(self, topics=left) if left else None

    def without_node(self, node: str) -> Connection | None:
        """Return what is left of the connection without ``node``.

        If ``node`` is an end, return ``None``. If ``node`` is the broker's node, return the
        connection without a broker.
        """
        return None if node in self.nodes else replace(self, broker="")

    def index_entries(self) -> Iterator[tuple[str, ...]]:
        """Yield the connection's entries in the ledger's index."""
        for end in self.nodes:
            yield ("link", str(self.type), end)
        if self.broker:
            yield ("broker", self.broker)
        for route in self.topics:
            _, taking = route.sender_and_receiver(self.source, self.target)
            yield ("brings", taking, route.written_topic)
