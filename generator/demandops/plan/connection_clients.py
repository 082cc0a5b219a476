"""The communication clients of claimed connections."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType

from demandops.config.config import Config
from demandops.connections import route as routes
from demandops.connections.communication_client import Client, ClientKey
from demandops.connections.connection_type import Connection, ConnectionType
from demandops.connections.route import Route
from demandops.demand.claim import ConnectionClaim, Subject, SubjectKind
from demandops.demand.connection_type_choice import route_faults
from demandops.errors import Refused
from demandops.ledger.ledger import Ledger


def client_keys(ledger: Ledger, connection: str) -> Iterator[ClientKey]:
    """Yield the keys of the clients that a connection needs."""
    first = ledger.first_claim(Subject(SubjectKind.CONNECTION, connection))
    if isinstance(first, ConnectionClaim):
        yield from first.type.keys(connection, first.source, first.target)


def client_at(ledger: Ledger, config: Config, key: ClientKey) -> Client | None:
    """Return the client at a key, or ``None`` if it carries no topic.

    Raises:
        Refused: if claims contradict each other, or the configuration no longer has what they need.
    """
    return key.type.client(key, _ClaimedConnections(ledger, config, key.type), config)


@dataclass(frozen=True, slots=True)
class _ClaimedConnections:
    """The connections that the ledger has of one type."""

    ledger: Ledger
    config: Config
    type: ConnectionType

    def at(self, node: str) -> Iterable[str]:
        """Return the connections that end at a node, sorted."""
        return self.ledger.connections_at(self.type, node)

    def get(self, id: str) -> Connection | None:
        """Return a connection, or ``None`` if it is not claimed with this type.

        Raises:
            Refused: if a person wrote a claim that its type cannot carry, or removed what it needs
                from the inventory.
        """
        claims = self.ledger.connection_claims(id)
        if not claims or claims[0].type is not self.type:
            return None
        first = claims[0]
        topics = {
            name: route
            for name, route in connection_topics(claims).items()
            if not is_bridged(route, first.source, first.target, self.config)
        }
        ends = (first.source, first.target)
        problems = list(route_faults(self.type, topics.values(), ends, self.config))
        if problems:
            raise Refused(
                replace(one, field="connections", message=f"'{id}': {one.message}")
                for one in problems
            )
        broker = next((claim.broker for claim in claims if claim.broker), "")
        return Connection(id, *ends, broker, MappingProxyType(topics))


def connection_topics(claims: Iterable[ConnectionClaim]) -> dict[str, Route]:
    """Return the routes of all claims on a connection by source topic, sorted."""
    return routes.merge_routes(route for claim in claims for route in claim.topics.values())


def is_bridged(route: Route, source: str, target: str, config: Config) -> bool:
    """Return whether the initial deployment already carries a topic between two ends.

    It keeps topic names, so it does not carry a route that renames the topic.
    """
    sender, receiver = route.sender_and_receiver(source, target)
    node = config.nodes.get(sender)
    if node is None or route.source != route.target:
        return False
    return route.read_topic in node.bridged.get(receiver, ())
