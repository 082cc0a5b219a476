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
        return Subject(SubjectKind.CONNECTION, self.id)

    @property
    def home(self) -> str:
        """The target; its access domain sets leases and quotas for the connection."""
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
        """Return the route of a source topic; the routes must be sorted, as those of a claim."""
        place = bisect_left(self.topics, source, key=attrgetter("source"))
        candidate = self.topics[place : place + 1]
        return candidate[0] if candidate and candidate[0].source == source else None

    def needs(self, node: str) -> bool:
        return node in (self.source, self.target, self.broker)

    def booked(self) -> Connection:
        return replace(self, topics=merged_routes(self.topics))

    def extended(self, more: Connection) -> Connection:
        topics, broker = (*self.topics, *more.topics), more.broker or self.broker
        return replace(more, topics=topics, broker=broker)

    def matches_listed(self, listed: object) -> bool:
        """Return whether a shutdown that lists ``listed`` means this connection of the same id."""
        return (  # what the shutdown leaves out matches any value
            isinstance(listed, Connection)
            and listed.source in ("", self.source)
            and listed.target in ("", self.target)
            and listed.type in (None, self.type)
        )

    def distinguishing_values(self) -> tuple[str, ...]:
        return (self.source, self.target, self.known_type.word)

    def topic_keys(self) -> Iterator[TopicKey]:
        for route in self.topics:
            yield (route.source,)

    def listed_topics(self, listed: object) -> Iterator[tuple[str, list[TopicKey]]]:
        """Yield (words, keys of this connection) for each topic that a shutdown lists."""
        assert isinstance(listed, Connection)  # noqa: S101 - see matches_listed
        carried = {*self.topic_keys()}
        for key in listed.topic_keys():
            yield f"topic {key[0]}", [key] if key in carried else []

    def without_topics(self, gone: Container[TopicKey]) -> Connection | None:
        left = tuple(route for route in self.topics if (route.source,) not in gone)
        return replace(self, topics=left) if left else None

    def without_node(self, node: str) -> Connection | None:
        """Return what is left of the connection without an end or without its broker."""
        return None if node in self.nodes else replace(self, broker="")

    def index_entries(self) -> Iterator[tuple[str, ...]]:
        for end in self.nodes:
            yield ("link", str(self.type), end)
        if self.broker:
            yield ("broker", self.broker)
        for route in self.topics:
            _, taking = route.sender_and_receiver(self.source, self.target)
            yield ("brings", taking, route.written_topic)
