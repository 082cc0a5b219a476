"""The communication clients of claimed connections."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from demandops.config.config import Config
from demandops.connections import route as routes
from demandops.connections.communication_client import Client, ClientKey
from demandops.connections.connection import Connection
from demandops.connections.connection_type import ConnectionType
from demandops.connections.route import Route
from demandops.demand.claim import Claim
from demandops.demand.connection_type_choice import route_faults
from demandops.errors import Refused
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World


def client_keys(ledger: Ledger, connection: str) -> Iterator[ClientKey]:
    """Yield the keys of the clients that a connection needs."""
    first = ledger.connection(connection)
    if first is not None:
        yield from first.known_type.keys(connection, *first.nodes)


def client_at(world: World, key: ClientKey) -> Client | None:
    """Return the client at a key, or ``None`` if it carries no topic.

    Raises:
        Refused: if claims contradict each other, or the configuration no longer has what they need.
    """
    return key.type.client(key, _ClaimedConnections(world, key.type), world.config)


@dataclass(frozen=True, slots=True)
class _ClaimedConnections:
    """The connections that the ledger has of one type."""

    world: World
    type: ConnectionType

    def at(self, node: str) -> Iterable[str]:
        """Return the connections that end at a node, sorted."""
        return self.world.ledger.connections_at(self.type, node)

    def get(self, id: str) -> Connection | None:
        """Return a connection, or ``None`` if it is not claimed with this type.

        Raises:
            Refused: if a person wrote a claim that its type cannot carry, or removed what it needs
                from the inventory.
        """
        first, claims = self.world.ledger.connection(id), self.world.ledger.connection_claims(id)
        if first is None or first.type is not self.type:
            return None
        topics = tuple(
            route
            for route in connection_topics(claims)
            if not is_bridged(route, *first.nodes, self.world.config)
        )
        problems = list(route_faults(self.type, topics, first.nodes, self.world.config))
        if problems:
            raise Refused(
                replace(one, field="connections", message=f"'{id}': {one.message}")
                for one in problems
            )
        brokers = (claim.connection.broker for claim in claims)
        return replace(first, broker=next(filter(None, brokers), ""), topics=topics)


def connection_topics(claims: Iterable[Claim]) -> tuple[Route, ...]:
    """Return the routes of all claims on a connection, sorted by source topic."""
    return routes.merged_routes(route for claim in claims for route in claim.connection.topics)


def is_bridged(route: Route, source: str, target: str, config: Config) -> bool:
    """Return whether the initial deployment already carries a topic between two ends.

    It keeps topic names, so it does not carry a route that renames the topic.
    """
    sender, receiver = route.sender_and_receiver(source, target)
    node = config.nodes.get(sender)
    if node is None or route.source != route.target:
        return False
    return route.read_topic in node.bridged.get(receiver, ())
