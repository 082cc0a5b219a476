"""Connections, their routes, and the interface that each type of connection implements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol, TypeVar

from pydantic import Field, PlainSerializer, PlainValidator, Strict, StrictBool
from pydantic.json_schema import SkipJsonSchema

from demandops.base import naming, strict_yaml
from demandops.base.errors import Fault, fault
from demandops.base.naming import Subject, SubjectKind, TopicKey
from demandops.base.quoting import quoted
from demandops.model.config.base_model import PART, RECORDED, Items, plain_number, without
from demandops.model.config.config import CLIENTS_FILE, Config, ConfigReader
from demandops.model.config.inventory import Node
from demandops.model.config.override import UNSHAPED, Shaping, patched_settings
from demandops.model.config.policy import AccessDomain
from demandops.model.config.registry import ClientSettings

# ---- routes: one topic of a connection, with its names, direction and options ----
#
# All valid options are here. Each connection type knows which of them it supports.


MessageType = Annotated[
    str, without(lambda value: naming.message_type_problem(value) if value else "")
]


@dataclass(frozen=True, slots=True)
class Route:
    """A topic of a connection; without ``target`` it has the same name at both ends.

    An option that has its default leaves the client's own behavior unchanged.
    """

    __pydantic_config__: ClassVar = PART

    source: str = ""  # the topic's name on the source node
    target: str = ""
    type: MessageType = ""  # the ROS message type, like `std_msgs/msg/String`
    reverse: StrictBool = False  # messages go from the target to the source
    # Options of MQTT; with `primitive`, the payload is plain text or a number, not a ROS message
    qos: Annotated[int, Strict(), Field(ge=0, le=2)] = 0
    retained: StrictBool = False
    primitive: StrictBool = False
    # Options of the clients' ROS publishers and subscribers
    reliability: Literal["", "reliable", "best_effort"] = ""
    durability: Literal["", "volatile", "transient_local"] = ""
    queue: Annotated[int, Strict(), Field(ge=0, le=100_000)] = 0
    # the highest one in Hz; 0 for all messages
    rate: Annotated[float, Field(ge=0, le=100_000, allow_inf_nan=False), plain_number] = 0.0
    # What the generator records in a claim: an application of the demand needs the route, and no
    # goal lists it; or the goal lists it under this id, and the claim's connection carries it.
    implied: Annotated[StrictBool, RECORDED, SkipJsonSchema()] = False
    listed: Annotated[str, RECORDED, SkipJsonSchema()] = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "source", naming.absolute_topic(self.source))
        object.__setattr__(self, "target", naming.absolute_topic(self.target) or self.source)

    def options(self) -> dict[str, Any]:
        return {
            name: value for name, default in _DEFAULTS if (value := getattr(self, name)) != default
        }

    @property
    def read_topic(self) -> str:  # on the node that the messages come from
        return self.target if self.reverse else self.source

    @property
    def written_topic(self) -> str:  # on the node that the messages go to
        return self.source if self.reverse else self.target

    @property
    def fact(self) -> str:
        """The route in words: ``topic /a to /b (qos 1)``."""
        options = self.options()
        direction = "from" if options.pop("reverse", False) else "to"
        listed = ", ".join(f"{name} {value}" for name, value in options.items())
        return f"topic {self.source} {direction} {self.target}" + (f" ({listed})" if listed else "")


_DEFAULTS = tuple(
    (item.name, item.default)
    for item in fields(Route)
    if item.name not in ("source", "target", "implied", "listed")
)


# The options of a route, in the order of its fields
ROUTE_OPTIONS = tuple(name for name, _ in _DEFAULTS)


def faults(where: str, routes: Iterable[Route]) -> Iterator[Fault]:
    """Yield the faults that a connection's routes have, whatever the type of the connection."""
    targets: dict[str, Route] = {}
    carried_back: dict[str, str] = {}
    for index, route in enumerate(routes):
        for side, name in (("source", route.source), ("target", route.target)):
            problem = naming.topic_problem(name)
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
        if first is None:
            merged[route.source] = route
        elif first != route:
            listed = route.listed if first.implied else first.listed
            better = route if route.type and not first.type else first
            implied = first.implied and route.implied
            merged[route.source] = replace(better, implied=implied, listed=listed)
    return tuple(merged[source] for source in sorted(merged))


class RouteKey(NamedTuple):
    """The identity of a route: its topic at both ends. At most one connection carries it."""

    sender: str  # the node that its messages come from
    topic: str  # its name there
    receiver: str
    target: str


# ---- connections ----


def _type_field() -> PlainValidator:
    # called when a reader is built, because the types' modules need this one
    from demandops.connections.connection_types import type_named, type_word  # noqa: PLC0415

    word = type_word("auto")

    def read(value: object) -> ConnectionType | None:
        if isinstance(value, ConnectionType):
            return value
        checked = word.func(value)  # type: ignore[call-arg]
        return None if checked == "auto" else type_named(str(checked))

    return PlainValidator(read, json_schema_input_type=word.json_schema_input_type)


@dataclass(frozen=True, slots=True)
class Connection:
    """One connection and the topics that it carries."""

    __pydantic_config__: ClassVar = PART

    id: str = ""
    # None if a demand leaves it open; that of a claim is not None
    type: Annotated[
        ConnectionType | None,
        _type_field(),
        PlainSerializer(lambda kind: kind.word, when_used="unless-none"),
        Field(json_schema_extra={"default": "auto"}),
    ] = None
    source: str = ""
    target: str = ""
    broker: str = ""  # empty if the generator chooses one
    topics: Items[Route] = ()

    @property
    def subject(self) -> Subject:
        return Subject(SubjectKind.CONNECTION, self.id)

    @property
    def home(self) -> str:
        # its access domain sets leases and quotas for the connection
        return self.target

    @property
    def nodes(self) -> tuple[str, str]:
        return (self.source, self.target)

    def route(self, source: str) -> Route | None:
        """Return the route of a source topic; the routes must be sorted, as those of a claim."""
        place = bisect_left(self.topics, source, key=attrgetter("source"))
        candidate = self.topics[place : place + 1]
        return candidate[0] if candidate and candidate[0].source == source else None

    def key_of(self, route: Route) -> RouteKey:
        sender, receiver = reversed(self.nodes) if route.reverse else self.nodes
        return RouteKey(sender, route.read_topic, receiver, route.written_topic)

    def keyed(self) -> Iterator[tuple[RouteKey, Route]]:
        return ((self.key_of(route), route) for route in self.topics)

    def route_of(self, key: RouteKey) -> Route | None:  # the routes must be sorted
        named = filter(None, map(self.route, dict.fromkeys((key.topic, key.target))))
        return next((route for route in named if self.key_of(route) == key), None)

    def needs(self, node: str) -> bool:
        return node in (self.source, self.target, self.broker)

    def booked(self) -> Connection:
        return replace(self, topics=merged_routes(self.topics))

    def extended(self, more: Connection) -> Connection:
        topics, broker = (*self.topics, *more.topics), more.broker or self.broker
        return replace(more, topics=topics, broker=broker)

    def topic_keys(self) -> Iterator[TopicKey]:
        for route in self.topics:
            yield (route.source,)

    def without_topics(self, gone: Container[TopicKey]) -> Connection | None:
        left = tuple(route for route in self.topics if (route.source,) not in gone)
        return replace(self, topics=left) if left else None

    def without_node(self, node: str) -> Connection | None:
        return None if node in self.nodes else replace(self, broker="")

    def index_entries(self) -> Iterator[tuple[str, ...]]:
        if self.type:
            yield ("link", self.type.name, self.source)
            yield ("link", self.type.name, self.target)
        if self.broker:
            yield ("broker", self.broker)
        for key, _ in self.keyed():
            yield ("route", *key)
            yield ("brings", key.receiver, key.target)
            yield ("from", key.sender)


# ---- the interface of a connection type, and of the clients that it plans ----
#
# Each type has a module with a subclass of :class:`ConnectionType`, which plans clients as data.
# :mod:`.gitops` makes a client's file from that data and from ``templates/connections/<type>/``.
# In that folder, ``client.yaml.j2`` is the template of a Deployment with the client's name, and
# ``schema.json`` lists the fields that the client's program reads.

Side = Literal["source", "target"]


@dataclass(frozen=True, slots=True)
class ClientKey:
    """The identity of a client: of one end of a connection, or of all at a node."""

    type: ConnectionType
    # With a side, of the connection; without, of the node whose connections share the client.
    id: str
    side: Side | None = None

    @property
    def name(self) -> str:
        return naming.object_name(self.type.word, self.id, *filter(None, [self.side]))


@dataclass(frozen=True, slots=True)
class Client(ABC):
    # the fields of its configuration that its program reads again while it runs; with a change of
    # any other, the client restarts
    reread: ClassVar[frozenset[str]] = frozenset()

    type: ConnectionType
    name: str
    node: Node
    domain: AccessDomain
    connections: tuple[str, ...]
    shaping: Shaping = field(default=UNSHAPED, kw_only=True)

    @property
    def images(self) -> tuple[str, ...]:
        return (self.type.image,)

    @property
    @abstractmethod
    def description(self) -> str:
        """The client in words, for commit messages."""

    @abstractmethod
    def facts(self) -> list[str]:
        """Return one line for each property of the client; commit messages show changed lines."""

    @abstractmethod
    def configuration(self) -> dict[str, Any]:
        """Return the configuration that the client's program reads."""

    def written(self, configuration: Mapping[str, Any]) -> str:
        return strict_yaml.dump(configuration)

    def settings(self, config: Config) -> ClientSettings:
        settings: ClientSettings = getattr(config.clients, self.type.word, ClientSettings())
        for file, patch in self.shaping.patches:
            settings = patched_settings(settings, patch, file)
        return settings

    def environment(self, settings: ClientSettings) -> dict[str, str]:
        # what the program needs besides the variables of `settings`
        return {}

    def shaping_entries(self, config: Config) -> Iterable[tuple[str, str, str]]:
        """Yield (file, entry, what the entry decides) for entries that affect the client."""
        # without node, access domain and images, which affect every release
        file = config.entry_files[CLIENTS_FILE].get(self.type.word)
        if file is not None:
            yield file, self.type.word, "how its container runs"


@dataclass(frozen=True, slots=True)
class End(Client):
    side: Side  # of its one connection
    peer: str
    topics: tuple[Route, ...]

    @property
    def description(self) -> str:
        (connection,) = self.connections
        return f"{self.type.name} {self.side} of connection {connection} on {self.node.id}"

    def facts(self) -> list[str]:
        return [route.fact for route in self.topics]

    def reads(self, route: Route) -> bool:
        # from ROS; otherwise, this end publishes the topic
        return route.reverse is (self.side == "target")


def message_type(route: Route, sender: str, config: Config) -> str:
    node = config.nodes.get(sender)
    return route.type or (node.types.get(route.read_topic, "") if node else "")


# The code of a fault if the inventory or the registry does not permit a connection's type
UNSUPPORTED = "unsupported-connection-type"

AnyEnd = TypeVar("AnyEnd", bound=End)


class Connections(Protocol):
    """The claimed connections of one type."""

    def get(self, id: str) -> Connection | None:
        """Return the claimed connection, if any; raise Refused if the type cannot carry it."""

    def at(self, node: str) -> Iterable[str]:
        """Return the ids of the connections that end at a node, sorted."""


# How many characters the topics may have in the id of a derived connection
_LONGEST_TOPICS = 120


class ConnectionType(ABC):
    """How clients carry a connection. Each subclass has one instance."""

    # The type's name in messages, and in files, templates and clients
    name: ClassVar[str]
    word: ClassVar[str]
    # The type's number in `DeploymentRequest`
    number: ClassVar[int]
    # The name of the clients' image in the registry
    image: ClassVar[str]
    # The route options that this connection type supports. Message type and direction are not
    # listed, because every type supports them.
    options: ClassVar[frozenset[str]]
    # Whether a topic may have another name at the target than at the source
    renames: ClassVar[bool] = False
    # Whether a demand may name a broker
    takes_broker: ClassVar[bool] = False
    # Whether the clients speak DDS themselves, so that both nodes must run a DDS middleware
    speaks_dds: ClassVar[bool] = True
    # Whether the clients must know the message type of each topic
    needs_types: ClassVar[bool] = False
    # Whether a client restarts with each new route, so that a derived connection has only one
    one_derived_route: ClassVar[bool] = False
    # What else the name of a connection names, in words; its clients meet there
    channel: ClassVar[str] = ""

    def __repr__(self) -> str:
        return self.name

    def config_faults(self, config: Config, reader: ConfigReader) -> Iterator[Fault]:
        return iter(())

    @abstractmethod
    def link_faults(self, connection: Connection, config: Config) -> Iterator[Fault]:
        """Yield why the type cannot link two nodes, which the inventory has."""

    def route_faults(
        self, where: str, route: Route, sender: str, config: Config
    ) -> Iterator[Fault]:
        # those that only this type can find; `where` is the route's path in the connection
        return iter(())

    def broker_node(self, connection: Connection, config: Config) -> str:
        # the node of the broker at which the clients will meet, if they need one
        return ""

    def derived_id(self, key: RouteKey) -> str:
        ends = f"derived/{key.sender}/{key.receiver}"
        if not self.one_derived_route:
            return ends
        topics = key.topic if key.topic == key.target else f"{key.topic}:{key.target}"
        if len(topics) > _LONGEST_TOPICS:
            topics = f"/{naming.hash_of(topics, 20)}"
        return ends + topics

    def keys(self, connection: str, source: str, target: str) -> Iterable[ClientKey]:
        # by default, each end has a client
        return ClientKey(self, connection, "source"), ClientKey(self, connection, "target")

    def names(self, key: ClientKey) -> Iterator[tuple[str, str]]:
        # (what it names, name) for each name that only the client at `key` may have
        yield "release", key.name
        if self.channel and key.side == "source":  # both ends share it
            yield self.channel, naming.object_name(self.word, key.id)

    @abstractmethod
    def client(self, key: ClientKey, connections: Connections, config: Config) -> Client | None:
        """Return the client at ``key``, or ``None`` if it carries no topic.

        Raises Refused if connections contradict each other, or miss what they need.
        """


def make_end(
    end: type[AnyEnd],
    key: ClientKey,
    connection: Connection,
    config: Config,
    **more: Any,  # noqa: ANN401 - the fields that the class `end` adds
) -> AnyEnd:
    own, peer = connection.source, connection.target
    if key.side == "target":
        own, peer = peer, own
    node, domain = config.node_and_domain(own)
    return end(
        type=key.type,
        name=key.name,
        node=node,
        domain=domain,
        connections=(connection.id,),
        side=key.side or "source",
        peer=peer,
        topics=connection.topics,
        **more,
    )
