"""The interface of a connection type: how clients carry a connection.

Each type has one module with a subclass of :class:`ConnectionType` and its clients. The subclass
defines what the type supports and needs, and plans the clients of each connection.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import Any, ClassVar, Protocol, TypeVar

from demandops import naming
from demandops.config.config import Config
from demandops.config.config_reader import ConfigReader
from demandops.connections.communication_client import Client, ClientKey, End
from demandops.connections.connection import Connection
from demandops.connections.route import Route
from demandops.errors import Fault, Refused, fault

UNSUPPORTED = "unsupported-connection-type"
"""The code of a fault: a type needs an entry that inventory or registry lack."""

AnyEnd = TypeVar("AnyEnd", bound=End)


class Connections(Protocol):
    """The claimed connections of one type."""

    def get(self, id: str) -> Connection | None:
        """Return a connection, or ``None`` if it is not claimed with this type.

        Raises:
            Refused: if the type cannot carry it.
        """

    def at(self, node: str) -> Iterable[str]:
        """Return the connections that end at a node, sorted."""


class ConnectionType(ABC):
    """How clients carry a connection. Each subclass has one instance."""

    name: ClassVar[str]
    """Its name in messages; files, templates and clients use ``word`` instead."""
    number: ClassVar[int]
    """Its number in ``DeploymentRequest``."""
    image: ClassVar[str]
    """The registry's name of its clients' image."""
    options: ClassVar[frozenset[str]]
    """The options of a route that it supports; each supports message type and direction."""
    renames: ClassVar[bool] = False
    """Whether a topic may have another name at the target."""
    takes_broker: ClassVar[bool] = False
    """Whether a demand may name a broker."""
    speaks_dds: ClassVar[bool] = True
    """Whether its clients speak DDS themselves, so that both nodes must run a DDS middleware."""

    def __repr__(self) -> str:
        """Return its name."""
        return self.name

    @property
    def word(self) -> str:
        """Its name in small letters."""
        return self.name.lower()

    @property
    def label(self) -> str:
        """Its number and name, for messages."""
        return f"{self.number} ({self.name})"

    def config_faults(self, config: Config, reader: ConfigReader) -> Iterator[Fault]:
        """Yield the faults of a configuration that prevent this type from working."""
        return iter(())

    def shares_clients(self, config: Config) -> bool:
        """Return whether a client may carry several connections."""
        return False

    @abstractmethod
    def link_faults(self, connection: Connection, config: Config) -> Iterator[Fault]:
        """Yield why the inventory does not let it link two ends.

        Unknown nodes are skipped, :mod:`demandops.demand.admission` reports them.
        """

    def route_faults(
        self, where: str, route: Route, sender: str, config: Config
    ) -> Iterator[Fault]:
        """Yield the other faults of a route from ``sender``, for example of its options."""
        return iter(())

    def access(self, connection: Connection, config: Config) -> list[tuple[str, str]]:
        """Return the fields of access rules, with values, that it needs besides both nodes."""
        return []

    def keys(self, connection: str, source: str, target: str) -> Iterable[ClientKey]:
        """Return the keys of the clients that a connection needs: by default, one at each end."""
        return ClientKey(self, connection, "source"), ClientKey(self, connection, "target")

    @abstractmethod
    def client(self, key: ClientKey, connections: Connections, config: Config) -> Client | None:
        """Return the client at a key, or ``None`` if it carries no topic.

        Raises:
            Refused: if connections contradict each other, or the configuration no longer has what
                they need.
        """


def unplannable(field: str, message: str, code: str = UNSUPPORTED) -> Refused:
    """Return the error for a claimed connection that cannot be planned."""
    return Refused([fault(field, message, code=code)])


def make_end(
    end: type[AnyEnd],
    key: ClientKey,
    connection: Connection,
    config: Config,
    **more: Any,  # noqa: ANN401 - any field
) -> AnyEnd:
    """Return one end of a connection; ``more`` are the fields that only this kind of end has.

    Raises:
        Refused: if its node is gone.
    """
    own, peer = connection.source, connection.target
    if key.side == "target":
        own, peer = peer, own
    node, domain = config.node_and_domain(own)
    return end(
        type=key.type,
        name=naming.object_name(key.type.word, connection.id, str(key.side)),
        node=node,
        domain=domain,
        connections=(connection.id,),
        side=key.side or "source",
        peer=peer,
        topics=connection.topics,
        **more,
    )
