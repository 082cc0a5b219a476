"""Communication clients: the programs that carry connections, as a connection type plans them.

A client is planned as data. :mod:`demandops.render.connection_client` makes its file from this and
from ``templates/connections/<type>/``: ``client.yaml.j2``, a Deployment with the client's name, and
``schema.json``, the fields that the program reads.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from demandops import strict_yaml
from demandops.config.config import Config
from demandops.config.inventory import Node
from demandops.config.override import UNSHAPED, Shaping
from demandops.config.policy import AccessDomain
from demandops.connections.route import Route

if TYPE_CHECKING:
    from demandops.connections.connection_type import ConnectionType

Side = Literal["source", "target"]


@dataclass(frozen=True, slots=True)
class ClientKey:
    """The identity of a client.

    ``id`` is the connection that it is a ``side`` of. Without a side it is the node whose
    connections of this type share the client.
    """

    type: ConnectionType
    id: str
    side: Side | None = None


@dataclass(frozen=True, slots=True)
class Client(ABC):
    """The desired state of one communication client."""

    type: ConnectionType
    name: str
    node: Node
    domain: AccessDomain
    connections: tuple[str, ...]
    """The connections that it carries."""
    shaping: Shaping = field(default=UNSHAPED, kw_only=True)

    @property
    def images(self) -> tuple[str, ...]:
        """The registry's names of its images."""
        return (self.type.image,)

    @property
    @abstractmethod
    def description(self) -> str:
        """Its description in commit messages."""

    @abstractmethod
    def facts(self) -> list[str]:
        """Return the client's properties as lines; commit messages show the changed ones."""

    @abstractmethod
    def configuration(self) -> dict[str, Any]:
        """Return the configuration that the program reads."""

    def written(self, configuration: Mapping[str, Any]) -> str:
        """Return a configuration as the text that the program reads."""
        return strict_yaml.dump(configuration)

    def needs_restart(self, configuration: dict[str, Any]) -> dict[str, Any]:
        """Return the part of a configuration that the program reads only at its start."""
        return configuration

    def shaping_entries(self, config: Config) -> Iterable[tuple[str, str, str]]:
        """Return (file, entry, effect) for each configuration entry that shapes the client."""
        return ()


@dataclass(frozen=True, slots=True)
class End(Client):
    """A client at one end of one connection."""

    side: Side
    peer: str
    topics: tuple[Route, ...]

    @property
    def description(self) -> str:
        """Name type, side, connection and node."""
        (connection,) = self.connections
        return f"{self.type.name} {self.side} of connection {connection} on {self.node.id}"

    def facts(self) -> list[str]:
        """Return the topics."""
        return [route.fact for route in self.topics]

    def reads(self, route: Route) -> bool:
        """Return whether this end reads the topic from ROS; the other end then publishes it."""
        return route.reverse is (self.side == "target")
