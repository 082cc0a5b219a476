"""Demands for connections in a short form, and states whose nodes can carry the connections."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import yaml
from demandops.decide.state import State
from demandops.model.config.load import load

from tests.kit import plain_yaml
from tests.kit.config import configuration, skeleton, state_of

REACHABLE = {"zenoh": {"endpoint": "tcp/edge:7447"}}
SPEAKS: dict[str, Any] = {"zenoh": {}}
WAN = {"wan": {"host": "192.0.2.1"}}
TYPED: dict[str, Any] = {"types": {"/a": "std_msgs/msg/String"}}
IMAGES = "registry/images.yaml"
ZENOH_IMAGE = "  zenoh-bridge: {repository: docker.io/eclipse/zenoh-bridge-ros2dds, tag: 1.10.0}\n"
ROS_IMAGE = "  dds-router: {repository: registry.example/dds-router, tag: v3.5.0}\n"
NO_BROKERS = yaml.safe_dump({"apiVersion": "demandops/v1", "kind": "Brokers", "brokers": []})


def state(
    images: str = ZENOH_IMAGE + ROS_IMAGE, *, brokers: bool = True, **nodes: dict[str, Any]
) -> State:
    """Return a state without claims; ``nodes`` has further fields of the nodes of the skeleton."""
    inventory = plain_yaml.load(skeleton()["inventory/nodes.yaml"])
    for node in inventory["nodes"]:
        node.update(deepcopy(nodes.get(node["id"], {})))
    changed = {
        "inventory/nodes.yaml": yaml.safe_dump(inventory),
        IMAGES: skeleton()[IMAGES] + images,
    }
    if not brokers:
        changed["inventory/brokers.yaml"] = NO_BROKERS
    return state_of(load(configuration(changed)))


def demand(kind: str = "auto", topics: Any = None, **more: Any) -> dict[str, Any]:
    topics = {"/a": "/a"} if topics is None else topics
    item = {"id": "c", "type": kind, "source": "vehicle00", "target": "edge", "topics": topics}
    return {"connections": [item | more]}


def routes(demand: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ``Demand`` document for a demand in short form.

    A demand in short form lists only connections. Such a connection has ``topics`` as the ledger
    writes them, and its ``type`` by name. It may list ``requesters``. The whole demand gets the
    requesters of the first connection.
    """
    connections = []
    for item in demand["connections"]:
        topics = [
            {"source": source, **({"target": said} if isinstance(said, str) else said)}
            for source, said in item.get("topics", {}).items()
        ]
        kept = {name: value for name, value in item.items() if name != "requesters"}
        connections.append(kept | {"topics": topics})
    ids = ", ".join(item["id"] for item in demand["connections"])
    requesters = demand["connections"][0].get("requesters", ["vehicle00"])
    head = {
        "kind": "Demand",
        "demand": f"{demand.get('id', 'request')} of {' '.join(requesters)}: {ids}",
        "requesters": requesters,
    }
    if demand.get("shutdown"):
        return head | {"operation": "release"}
    return head | {"connections": connections}
