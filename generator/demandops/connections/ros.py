"""ROS connections: each end is an eProsima DDS-Router that links the node to the other end.

The configuration has the format v5.0, as DDS-Router v3.5 reads it. A running router reads the
mounted file again at an interval and accepts a new allowlist. Any other change restarts the pod.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from demandops.base import naming
from demandops.base.addresses import in_url, is_ip
from demandops.base.errors import Fault, Refused, fault
from demandops.connections import connection as routes
from demandops.connections.connection import ClientKey, Connection, Connections, ConnectionType, End
from demandops.model.config.config import NODES_FILE, Config
from demandops.model.config.inventory import Node, Wan

_LOCAL, _WAN = "local", "wan"


class Ros(ConnectionType):
    name, word = "ROS", "ros"
    number = 0
    image = "dds-router"
    options = frozenset({"reliability", "durability", "queue", "rate"})
    needs_types = True

    def link_faults(self, connection: Connection, config: Config) -> Iterator[Fault]:
        if _listener(connection, config) is None:
            message = (
                f"{self.name} needs an end with a reachable address; add 'wan: {{host: …}}' to "
                f"'{connection.source}' or '{connection.target}' in {config.place_of(NODES_FILE)}"
            )
            yield fault("type", message, code=routes.UNSUPPORTED)

    def route_faults(
        self, where: str, route: routes.Route, sender: str, config: Config
    ) -> Iterator[Fault]:
        if sender in config.nodes and not routes.message_type(route, sender, config):
            yield fault(
                f"{where}.type",
                f"the message type of '{route.source}' is not known, and ROS needs it; give the "
                "type in the request, if the request has a field for it, or add the type under "
                f"'types' of '{sender}' in {config.file_of(NODES_FILE, sender)}",
            )
        if route.durability and not route.reliability:
            yield fault(
                f"{where}.reliability",
                f"is not given, but durability of '{route.source}' is; the router takes durability "
                "only with reliability, so add reliability",
            )

    def client(self, key: ClientKey, connections: Connections, config: Config) -> RosEnd | None:
        connection = connections.get(key.id)
        if connection is None or not connection.topics:
            return None
        typed = tuple(
            replace(route, type=routes.message_type(route, route_key.sender, config))
            for route_key, route in connection.keyed()
        )
        listener = _listener(connection, config)
        if listener is None or listener.wan is None:
            message = f"connection '{key.id}' has no end with a wan address any longer; "
            message += "restore wan at one end"
            raise Refused.at("connections", message, code=routes.UNSUPPORTED)
        port = _port(key.id, listener.wan)
        for other in connections.at(listener.id):
            if other == key.id or _port(other, listener.wan) != port:
                continue
            rival = connections.get(other)
            if rival is not None and _listener(rival, config) is listener:
                message = (
                    f"connection '{key.id}' would listen on port {port} of "
                    f"'{listener.id}', but connection '{other}' already does; use another "
                    "connection id, or widen the range from 'firstPort' to 'lastPort' under 'wan' "
                    f"of '{listener.id}'"
                )
                raise Refused.at("connections", message, code=routes.UNSUPPORTED)
        connection = replace(connection, topics=typed)
        return routes.make_end(
            RosEnd, key, connection, config, listener=listener.id, wan=listener.wan, port=port
        )


ROS = Ros()


def _listener(connection: Connection, config: Config) -> Node | None:
    for id in (connection.target, connection.source):  # the target if both can listen
        node = config.nodes.get(id)
        if node is not None and node.wan is not None:
            return node
    return None


def _port(connection: str, wan: Wan) -> int:
    # only from the id and the range, so that no other connection changes it
    return wan.first_port + _number(connection) % (wan.last_port - wan.first_port + 1)


@lru_cache(maxsize=65_536)  # the ports of all connections at a node are compared
def _number(connection: str) -> int:
    return int(naming.digest("port", connection), 16)


@dataclass(frozen=True, slots=True)
class RosEnd(End):
    """Each route in ``topics`` has its message type set."""

    # So a new topic restarts the router only if it needs an entry in `topics` (QoS settings) or
    # `topic-routes` (reverse direction).
    reread = frozenset({"allowlist"})

    # The id of the node that listens; its address is `wan`, and its port is `port`
    listener: str
    wan: Wan
    port: int

    def facts(self) -> list[str]:
        return [*End.facts(self), f"address {in_url(self.wan.host)}:{self.port}"]

    def configuration(self) -> dict[str, Any]:
        # Each topic passes in one direction only: the router at one end subscribes to it, and the
        # router at the other end publishes it. The key `routes` is for topics that come from the
        # source, as most do.
        inward, outward = _routes(_LOCAL, _WAN), _routes(_WAN, _LOCAL)
        topics, tuned, reverse = [], [], []
        for route in self.topics:
            reads = self.reads(route)
            # the names that ROS gives a topic and its type in DDS
            package, kind, name = route.type.split("/")
            dds_type = f"{package}::{kind}::dds_::{name}_"
            topic = {"name": f"rt{route.read_topic}", "type": dds_type}
            topics.append(topic)
            qos: dict[str, Any] = {}
            if route.reliability:
                qos["reliability"] = route.reliability == "reliable"
            if route.durability:
                qos["durability"] = route.durability == "transient_local"
            if route.queue:
                qos["history-depth"] = route.queue
            if route.rate and reads:  # no surplus messages cross the link
                qos["max-tx-rate"] = route.rate
            if qos:
                tuned.append({**topic, "qos": qos})
            if route.reverse:
                reverse.append({**topic, "routes": inward if reads else outward})
        listens = self.node.id == self.listener
        address = {
            "ip" if is_ip(self.wan.host) else "domain": self.wan.host,
            "port": self.port,
            "transport": self.wan.transport,
        }
        return {
            "version": "v5.0",
            "allowlist": topics,
            **({"topics": tuned} if tuned else {}),
            "routes": inward if self.side == "source" else outward,
            **({"topic-routes": reverse} if reverse else {}),
            "participants": [
                {"name": _LOCAL, "kind": "local", "domain": self.node.ros.domain_id},
                {
                    "name": _WAN,
                    "kind": "wan",
                    "listening-addresses" if listens else "connection-addresses": [address],
                },
            ],
        }


def _routes(sender: str, receiver: str) -> list[dict[str, Any]]:
    # messages pass only from the sender to the receiver
    return [{"src": sender, "dst": [receiver]}, {"src": receiver}]
