"""The map from the reference's resources to the applications and connections of demands.

The reference makes the name of a resource from ids: ``/``, ``_`` and ``-`` all become ``-``. So the
ids cannot be derived from the name with certainty. :func:`propose` proposes a map, and a person
checks this map.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints

from demandops.config.base_model import CamelModel, FileModel, Items
from demandops.config.config import BROKERS_FILE, Config
from demandops.config.inventory import Broker
from demandops.migration.reference_files import (
    CONNECTION,
    FUSION,
    MqttConnection,
    ObjectDetection,
    ObjectFusion,
    ReferenceFiles,
)
from demandops.migration.remaining_joins import Join
from demandops.settings import API_VERSION

_Filled = Annotated[str, StringConstraints(min_length=1)]
_REQUEST = "imported"
_OBJECT_LIST = "_local_objectlist"


class PointCloud(CamelModel):
    """A point cloud from which a detection makes an object list: its topic and its source node."""

    topic: _Filled
    source: _Filled


class MappedApplication(CamelModel):
    """An application of the reference's only type.

    ``egoData`` maps each topic with ego data to the node that publishes the topic. ``pointClouds``
    maps each topic with an object list to the point cloud from which the list is made.
    """

    id: _Filled
    node: _Filled
    ego_data: dict[str, _Filled] = Field(default_factory=dict)
    point_clouds: dict[str, PointCloud] = Field(default_factory=dict)


class MappedTopic(CamelModel):
    """A topic of a connection, by its name at both ends."""

    source: _Filled
    target: _Filled


class MappedConnection(CamelModel):
    """An MQTT connection. If ``broker`` is empty, the generator chooses a broker."""

    id: _Filled
    source: _Filled
    target: _Filled
    broker: str = ""
    topics: Items[MappedTopic]


class ReferenceMap(FileModel):
    """The application or connection that each resource of the reference stands for.

    ``request`` is the request id for the imported goals, because the reference records no id.
    """

    kind: Literal["ReferenceMap"]
    request: _Filled
    applications: dict[str, MappedApplication] = Field(default_factory=dict)
    connections: dict[str, MappedConnection] = Field(default_factory=dict)


def slug(id: str) -> str:
    """Return an id as the names of resources contain it: with ``-`` for each ``_`` and ``/``."""
    return id.replace("_", "-").replace("/", "-")


def is_object_list(topic: str) -> bool:
    """Return whether a topic has an object list, by its name in the reference."""
    return topic.endswith(_OBJECT_LIST)


def is_host(broker: Broker, host: str, port: object) -> bool:
    """Return whether a broker is at the address ``host`` and ``port``.

    The host in the inventory may be longer than ``host``: it may end in the namespace, as in
    ``broker.c-its``.
    """
    return port == broker.port and f"{broker.host}.".startswith(f"{host}.")


def propose(
    joins: Mapping[str, list[Join]], files: ReferenceFiles, config: Config
) -> tuple[dict[str, Any], list[str]]:
    """Return a proposed map as plain data, and warnings.

    If the value of a field is not known, the field is empty, and a person fills it in.

    Args:
        joins: maps a resource to the joins that no shutdown has undone yet.
        files: has the resources' specs.
        config: has the nodes and brokers of the inventory.
    """
    inventory = _Inventory(files, config)
    fusions = [name for name in joins if name.startswith(FUSION)]
    connections = [name for name in joins if name.startswith(CONNECTION)]
    data = {
        "apiVersion": API_VERSION,
        "kind": "ReferenceMap",
        "request": _REQUEST,
        "applications": {name: inventory.application(name, joins[name]) for name in fusions},
        "connections": {name: inventory.connection(name) for name in connections},
    }
    return data, inventory.warnings


class _Inventory:
    """Finds nodes, topics and brokers for the map: in the resources, otherwise in the inventory."""

    def __init__(self, files: ReferenceFiles, config: Config) -> None:
        self._connections = files.specs_of(MqttConnection)
        self._detections = files.specs_of(ObjectDetection).values()
        self._fusions = files.specs_of(ObjectFusion)
        self._nodes, self._brokers = config.nodes.values(), config.brokers.values()
        self._broker_files = config.place_of(BROKERS_FILE)
        self.warnings: list[str] = []

    def application(self, name: str, joins: list[Join]) -> dict[str, Any]:
        id, spec = name.removeprefix(FUSION), self._fusions.get(name)
        named = [one.id for one in self._nodes if id.startswith(f"{slug(one.id)}-")]
        node = spec.node if spec else max(named, key=len, default="")
        rest = id.removeprefix(f"{slug(node)}-")
        topics = dict.fromkeys(topic for join in joins for topic in join.topics)
        clouds = [topic for topic in topics if is_object_list(topic)]
        return {
            "id": f"{node}/{rest.replace('-', '_')}" if node and rest != id else "",
            "node": node,
            "egoData": {
                topic: self._source(topic, node) for topic in topics if topic not in clouds
            },
            "pointClouds": {topic: self._point_cloud(topic, node) for topic in clouds},
        }

    def _point_cloud(self, object_list: str, node: str) -> dict[str, str]:
        source = object_list.removeprefix("/").removesuffix(_OBJECT_LIST)
        topics = [one.topic for one in self._detections if (one.node, one.source) == (node, source)]
        return {"topic": topics[0] if topics else "", "source": source}

    def _source(self, topic: str, node: str) -> str:
        """Return the node that probably publishes a topic, or an empty text.

        This is the source of a connection that brings the topic to ``node``. If there is none, it
        is a node whose inventory entry lists the topic.
        """
        over = [
            spec.source
            for spec in self._connections.values()
            if spec.target == node and topic in (target for _, target in spec.topics())
        ]
        usual = [one.id for one in self._nodes if topic in one.topics.values()]
        return next(iter([*over, *usual]), "")

    def connection(self, name: str) -> dict[str, Any]:
        id, spec = name.removeprefix(CONNECTION), self._connections.get(name)
        if spec is None:
            ends = [
                (one.id, other.id)
                for one in self._nodes
                for other in self._nodes
                if slug(f"{one.id}/{other.id}") == id
            ]
            source, target = ends[0] if ends else ("", "")
            topics, broker = [("", "")], ""
        else:
            source, target, topics = spec.source, spec.target, spec.topics() or [("", "")]
            broker = self._broker(name, spec)
            if more := spec.dropped_topics():
                self.warnings.append(
                    f"{name}: earlier requests also listed {', '.join(more)}; the connection's "
                    "clients may still carry these topics, so add the needed ones to the map"
                )
        return {
            "id": f"{source}/{target}" if source and slug(f"{source}/{target}") == id else "",
            "source": source,
            "target": target,
            "broker": broker,
            "topics": [{"source": one, "target": other} for one, other in topics],
        }

    def _broker(self, name: str, spec: MqttConnection) -> str:
        for broker in self._brokers:
            if is_host(broker, spec.host, spec.port):
                return broker.node
        self.warnings.append(
            f"{name}: its broker {spec.host}:{spec.port} is not in {self._broker_files}; add the "
            "broker there and its node to the map, or leave the field empty, so that the generator "
            "chooses one"
        )
        return ""
