"""Routes: one topic of a connection, with its names, direction and options.

Requests and claims contain routes, and the configuration of clients follows from the routes. This
module knows all valid options. Each connection type knows which of these options it supports.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from demandops.base.errors import Fault, fault
from demandops.base.naming import (
    Subject,
    SubjectKind,
    TopicKey,
    message_type_problem,
    topic_problem,
)
from demandops.base.quoting import quoted
from demandops.model.config.base_model import FrozenModel, without

if TYPE_CHECKING:
    from demandops.connections.connection_type import ConnectionType


@dataclass(frozen=True, slots=True)
class Route:
    """One topic that a connection carries.

    ``source`` is the topic's name on the source node, and ``target`` its name on the target node.
    With ``reverse``, messages go from the target to the source. ``type`` is the ROS message type
    (``std_msgs/msg/String``), empty if not given. An option that has its default leaves the
    client's own behavior unchanged.

    ``qos`` (0 to 2), ``retained`` and ``primitive`` (the payload is plain text or a number, not a
    ROS message) are options of MQTT. ``reliability``, ``durability`` and ``queue`` are options of
    the clients' ROS publishers and subscribers. ``rate`` is the highest rate in Hz, 0 for all
    messages.
    """

    source: str
    target: str
    type: str = ""
    reverse: bool = False
    qos: int = 0
    retained: bool = False
    primitive: bool = False
    reliability: str = ""
    durability: str = ""
    queue: int = 0
    rate: float = 0.0

    def options(self) -> dict[str, Any]:
        return {
            name: value for name, default in _DEFAULTS if (value := getattr(self, name)) != default
        }

    @property
    def read_topic(self) -> str:
        """The topic's name on the node that the messages come from."""
        return self.target if self.reverse else self.source

    @property
    def written_topic(self) -> str:
        """The topic's name on the node that the messages go to."""
        return self.source if self.reverse else self.target

    @property
    def fact(self) -> str:
        """The route in words: ``topic /a to /b (qos 1)``."""
        options = self.options()
        direction = "from" if options.pop("reverse", False) else "to"
        listed = ", ".join(f"{name} {value}" for name, value in options.items())
        return f"topic {self.source} {direction} {self.target}" + (f" ({listed})" if listed else "")

    def sender_and_receiver(self, source: str, target: str) -> tuple[str, str]:
        return (target, source) if self.reverse else (source, target)


_DEFAULTS = tuple(
    (item.name, item.default) for item in fields(Route) if item.name not in ("source", "target")
)


MessageType = Annotated[str, without(lambda value: message_type_problem(value) if value else "")]


class RouteOptions(FrozenModel):
    """The options of a route in messages and files; the defaults are those of :class:`Route`."""

    type: MessageType = ""
    reverse: bool = False
    qos: Annotated[int, Field(ge=0, le=2)] = 0
    retained: bool = False
    primitive: bool = False
    reliability: Literal["", "reliable", "best_effort"] = ""
    durability: Literal["", "volatile", "transient_local"] = ""
    queue: Annotated[int, Field(ge=0, le=100_000)] = 0
    rate: Annotated[float, Field(ge=0, le=100_000, allow_inf_nan=False, strict=False)] = 0.0

    def route(self, source: str, target: str) -> Route:
        return Route(source, target, **self.model_dump(include=set(RouteOptions.model_fields)))


def faults(where: str, routes: Iterable[Route]) -> Iterator[Fault]:
    """Yield the faults that a connection's routes have, whatever the type of the connection."""
    targets: dict[str, Route] = {}
    carried_back: dict[str, str] = {}
    for index, route in enumerate(routes):
        for side, name in (("source", route.source), ("target", route.target)):
            problem = topic_problem(name)
            if problem:
                yield fault(f"{where}[{index}].{side}", problem)
        first = targets.setdefault(route.source, route)
        if first.target != route.target:
            yield fault(
                f"{where}[{index}].target",
                f"{quoted(route.source)} goes to {quoted(first.target)} and to "
                f"{quoted(route.target)}; a connection carries a source topic to only one "
                "target topic, so use a second connection",
            )
        for name, value, other in contradictions(first, route):
            yield fault(
                f"{where}[{index}].{name}",
                f"{quoted(route.source)} is listed with {name} {value} and {other}; list it once",
            )
        if route.reverse and carried_back.setdefault(route.target, route.source) != route.source:
            yield fault(
                f"{where}[{index}].target",
                f"{quoted(route.target)} is carried back to {quoted(carried_back[route.target])} "
                f"and to {quoted(route.source)}; a connection carries a target topic back to only "
                "one source topic, so use a second connection",
            )


def contradictions(route: Route, other: Route) -> Iterator[tuple[str, object, object]]:
    """Yield (option, first value, second value) for each contradiction between two routes."""
    for name, _ in _DEFAULTS:
        first, second = getattr(route, name), getattr(other, name)
        # an empty type leaves it to the other route, or to the inventory
        if first == second or (name == "type" and not (first and second)):
            continue
        yield name, _shown(first), _shown(second)


def _shown(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value!r}"


def merged_routes(routes: Iterable[Route]) -> tuple[Route, ...]:
    """Return one route for each source topic, sorted: the first, or the first with a type."""
    merged: dict[str, Route] = {}
    for route in routes:
        first = merged.get(route.source)
        if first is None or (route.type and not first.type):
            merged[route.source] = route
    return tuple(merged[source] for source in sorted(merged))


# ---- connections: demands list them, claims hold them, and clients carry them ----


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
