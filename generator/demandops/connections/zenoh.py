"""Zenoh connections: each node has one zenoh-bridge-ros2dds for all its connections.

Two bridges must not share a host and a ROS domain. The configuration is that of
eclipse-zenoh/zenoh-plugin-ros2dds 1.10. A bridge reads its configuration only at its start.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from demandops.base import naming
from demandops.base.errors import Fault, Refused, fault
from demandops.connections import connection as routes
from demandops.connections.connection import UNSUPPORTED, Client, ClientKey, Connection, Connections
from demandops.model.config.config import NODES_FILE, Config, ConfigReader


class Zenoh(routes.ConnectionType):
    name, word = "ZENOH", "zenoh"
    number = 2
    image = "zenoh-bridge"
    options = frozenset({"rate"})

    def config_faults(self, config: Config, reader: ConfigReader) -> Iterator[Fault]:
        # two bridges on one host and ROS domain do not work
        hosts: dict[tuple[object, ...], str] = {}
        for node in config.nodes.values():
            host = (node.cluster, node.ros.domain_id, *sorted(node.labels.items()))
            if node.zenoh and (other := hosts.setdefault(host, node.id)) != node.id:
                file, place = reader.places[NODES_FILE][node.id]
                yield fault(
                    f"{place}.zenoh",
                    f"'{other}' already runs a bridge on the same host and ROS domain; remove one "
                    "of the two bridges",
                ).within(file)

    def link_faults(self, connection: Connection, config: Config) -> Iterator[Fault]:
        source, target = (config.nodes[end] for end in connection.nodes)
        for end, node in (("source", source), ("target", target)):
            if node.zenoh is None:
                message = (
                    f"'{node.id}' runs no Zenoh bridge; add 'zenoh: {{endpoint: …}}' to the node "
                    f"in {config.file_of(NODES_FILE, node.id)}, or 'zenoh: {{}}' if the node can "
                    "reach other bridges"
                )
                yield fault(end, message, code=UNSUPPORTED)
        if source.zenoh is None or target.zenoh is None or source.id == target.id:
            return
        shared = set(source.zenoh.connect) & set(target.zenoh.connect)
        if not (source.zenoh.endpoint or target.zenoh.endpoint or shared):
            message = (
                f"{self.name} cannot link '{source.id}' and '{target.id}'; in "
                f"{config.place_of(NODES_FILE)}, give one of the nodes an 'endpoint' under "
                "'zenoh', or list the same router under 'connect' of both nodes"
            )
            yield fault("type", message, code=UNSUPPORTED)

    def keys(self, connection: str, source: str, target: str) -> Iterable[ClientKey]:
        return ClientKey(self, source), ClientKey(self, target)

    def client(self, key: ClientKey, connections: Connections, config: Config) -> Bridge | None:
        publishers: dict[str, tuple[float, str]] = {}
        subscribers: set[str] = set()
        peers: dict[str, str] = {}
        for id in connections.at(key.id):
            connection = connections.get(id)
            if connection is None or not connection.topics:
                continue
            source, target = connection.nodes
            peers[id] = target if key.id == source else source
            for route in connection.topics:
                if key.id != connection.key_of(route).sender:
                    subscribers.add(route.written_topic)
                    continue
                rate, other = publishers.setdefault(route.read_topic, (route.rate, id))
                if rate != route.rate:
                    message = (
                        f"connections '{other}' and '{id}' carry '{route.read_topic}' from "
                        f"'{key.id}' with the rates {rate} and {route.rate}, but a Zenoh bridge "
                        "has one rate for each topic; use the same rate in both connections"
                    )
                    raise Refused.at("connections", message, code="conflict")
        if not peers:
            return None
        node, domain = config.node_and_domain(key.id)
        if node.zenoh is None:
            message = (
                f"'{node.id}' carries Zenoh connections, but has no 'zenoh' in "
                f"{config.file_of(NODES_FILE, node.id)} any longer; restore 'zenoh' there"
            )
            raise Refused.at("node", message, code=UNSUPPORTED)
        endpoints = {*node.zenoh.connect}
        for id in {*peers.values()}:
            peer = config.nodes.get(id)
            endpoint = peer.zenoh.endpoint if peer and peer.zenoh else None
            # if both can reach the other, only the first connects, so that there is only one link
            if endpoint and (not node.zenoh.endpoint or node.id < id):
                endpoints.add(endpoint)
        return Bridge(
            type=self,
            name=key.name,
            node=node,
            domain=domain,
            connections=tuple(peers),
            publishers=tuple(sorted(publishers)),
            subscribers=tuple(sorted(subscribers)),
            rates=MappingProxyType(
                {t: rate for t, (rate, _) in sorted(publishers.items()) if rate}
            ),
            connect=tuple(sorted(endpoints)),
            listen=node.zenoh.listening(),
        )


ZENOH = Zenoh()


@dataclass(frozen=True, slots=True)
class Bridge(Client):
    """The desired state of a node's Zenoh bridge."""

    # The topics that the bridge reads from the node's ROS graph, and those that it publishes there
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    rates: Mapping[str, float]  # the most messages per second of a topic that the bridge reads
    connect: tuple[str, ...]
    listen: tuple[str, ...]

    @property
    def description(self) -> str:
        return f"Zenoh bridge on {self.node.id}"

    def facts(self) -> list[str]:
        return [
            *(f"connection {id}" for id in self.connections),
            *(f"reads {topic}" for topic in self.publishers),
            *(f"writes {topic}" for topic in self.subscribers),
            *(f"rate {rate:g} of {topic}" for topic, rate in self.rates.items()),
            *(f"connects to {endpoint}" for endpoint in self.connect),
        ]

    def configuration(self) -> dict[str, Any]:
        # if `allow` lacks `publishers` or `subscribers`, no topic of that kind passes
        lists = {"publishers": self.publishers, "subscribers": self.subscribers}
        ros: dict[str, Any] = {
            "nodename": naming.ros_name(self.name),
            "domain": self.node.ros.domain_id,
            "allow": {
                name: [_exactly(topic) for topic in topics]
                for name, topics in lists.items()
                if topics
            },
        }
        if self.rates:
            ros["pub_max_frequencies"] = [
                f"{_exactly(topic)}={rate:g}" for topic, rate in self.rates.items()
            ]
        return {
            "mode": "router",
            "connect": {"endpoints": list(self.connect)},
            "listen": {"endpoints": list(self.listen)},
            # the state repo defines which bridges connect
            "scouting": {"multicast": {"enabled": False}},
            "plugins": {"ros2dds": ros},
        }

    def written(self, configuration: Mapping[str, Any]) -> str:
        return json.dumps(configuration, indent=2, ensure_ascii=False) + "\n"


def _exactly(topic: str) -> str:
    return f"^{re.escape(topic)}$"  # the bridge takes regular expressions
