"""The interface of a connection type, and of the clients that it plans.

Each type has one module with a subclass of :class:`ConnectionType` and its clients. The subclass
defines what the type supports and needs, and plans the clients of each connection as data.
:mod:`.manifests` makes a client's file from that data and from
``templates/connections/<type>/``. In that folder, ``client.yaml.j2`` is the template of a
Deployment with the client's name, and ``schema.json`` lists the fields that the client's program
reads.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Protocol, TypeVar

from demandops.base import naming, strict_yaml
from demandops.base.errors import Fault
from demandops.connections.connection import Connection, Route
from demandops.model.config.config import CLIENTS_FILE, Config, ConfigReader
from demandops.model.config.inventory import Node
from demandops.model.config.override import UNSHAPED, Shaping, patched_settings
from demandops.model.config.policy import AccessDomain
from demandops.model.config.registry import ClientSettings

Side = Literal["source", "target"]


@dataclass(frozen=True, slots=True)
class ClientKey:
    """The identity of a client: of one end of a connection, or of all at a node.

    With a ``side``, ``id`` is the connection of which the client is one end. Without a side, ``id``
    is the node whose connections of this type share the client.
    """

    type: ConnectionType
    id: str
    side: Side | None = None

    @property
    def name(self) -> str:
        return naming.object_name(self.type.word, self.id, *filter(None, [self.side]))


@dataclass(frozen=True, slots=True)
class Client(ABC):
    """The desired state of one communication client."""

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

    def read_at_start(self, configuration: dict[str, Any]) -> dict[str, Any]:
        """Return the part of a configuration with whose change the client restarts."""
        return configuration

    def settings(self, config: Config) -> ClientSettings:
        settings = config.clients.of(self.type.word)
        for file, patch in self.shaping.patches:
            settings = patched_settings(settings, patch, file)
        return settings

    def environment(self, settings: ClientSettings) -> dict[str, str]:
        """Return the environment variables that the program needs besides those of ``settings``."""
        return {}

    def shaping_entries(self, config: Config) -> Iterable[tuple[str, str, str]]:
        """Yield (file, entry, what the entry decides) for entries that affect the client."""
        # without node, access domain and images, which affect every release
        file = config.entry_files.get(CLIENTS_FILE, {}).get(self.type.word)
        if file is not None:
            yield file, self.type.word, "how its container runs"


@dataclass(frozen=True, slots=True)
class End(Client):
    """A client at one end of one connection."""

    side: Side
    peer: str
    topics: tuple[Route, ...]

    @property
    def description(self) -> str:
        (connection,) = self.connections
        return f"{self.type.name} {self.side} of connection {connection} on {self.node.id}"

    def facts(self) -> list[str]:
        return [route.fact for route in self.topics]

    def reads(self, route: Route) -> bool:
        """Return whether this end reads the topic from ROS. If not, it publishes the topic."""
        return route.reverse is (self.side == "target")


def message_type(route: Route, sender: str, config: Config) -> str:
    """Return the message type of a route whose messages come from ``sender``; empty if unknown."""
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


class ConnectionType(ABC):
    """How clients carry a connection. Each subclass has one instance."""

    # The type's name in messages; files, templates and clients use `word` instead
    name: ClassVar[str]
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

    def __repr__(self) -> str:
        return self.name

    @property
    def word(self) -> str:
        return self.name.lower()

    def config_faults(self, config: Config, reader: ConfigReader) -> Iterator[Fault]:
        """Yield the faults of a configuration that prevent this type from working."""
        return iter(())

    def shares_clients(self, config: Config) -> bool:
        return False

    @abstractmethod
    def link_faults(self, connection: Connection, config: Config) -> Iterator[Fault]:
        """Yield a fault for each reason why the type cannot link the two nodes of a connection.

        Unknown nodes are no fault here, because :mod:`.admission` reports them.
        """

    def route_faults(
        self, where: str, route: Route, sender: str, config: Config
    ) -> Iterator[Fault]:
        """Yield those faults of a route that only this type can find.

        ``where`` is the route's path in the connection, such as ``topics[0]``. ``sender`` is the
        node that the messages come from.
        """
        return iter(())

    def settled(self, connection: Connection, config: Config) -> tuple[Connection, str]:
        """Return the connection as clients will carry it, and a note of how it differs, if it does.

        The generator checks the connection only after this call, so it may have faults.
        """
        return connection, ""

    def access(self, connection: Connection, config: Config) -> list[tuple[str, str]]:
        """Return the access that a demand for the connection needs besides access to its nodes.

        Each item is a field of a policy's rule, and the value that this field must allow.
        """
        return []

    def keys(self, connection: str, source: str, target: str) -> Iterable[ClientKey]:
        """Return the keys of the clients that a connection needs. By default, each end has one."""
        return ClientKey(self, connection, "source"), ClientKey(self, connection, "target")

    def names(self, key: ClientKey) -> Iterator[tuple[str, str]]:
        """Yield (what it names, name) for each name that only the client at ``key`` may have."""
        yield "release", key.name

    @abstractmethod
    def client(self, key: ClientKey, connections: Connections, config: Config) -> Client | None:
        """Return the client that ``key`` identifies, or ``None`` if the client carries no topic.

        Raises Refused if connections contradict each other, or the configuration no longer has what
        they need.
        """


def make_end(
    end: type[AnyEnd],
    key: ClientKey,
    connection: Connection,
    config: Config,
    **more: Any,  # noqa: ANN401 - any field
) -> AnyEnd:
    """Return one end of a connection; ``more`` has the fields that its own class adds."""
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
