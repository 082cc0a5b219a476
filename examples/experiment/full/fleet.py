"""The state repo of the experiment: the skeleton's files, changed to run on one machine.

Connections to the edge use MQTT, as in the paper, or Zenoh. Connections to the cloud use MQTT.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Literal

import yaml

from examples.experiment.paper import S

from .participants import POSE, STATION_CLOUD
from .rig import free_port, override
from .routes import VEHICLES
from .rules import RULES

Carrier = Literal["mqtt", "zenoh"]
NODES = (*VEHICLES, S, "edge", "cloud")
_WATCHER = {"package": "demandops_ros", "launchFile": "parameter_sync.launch.xml"}
"""Lets the fusion follow its ConfigMap by a watch."""
_BRIDGE = {"repository": "docker.io/eclipse/zenoh-bridge-ros2dds", "tag": "1.10.0"}
_ZENOH = 2
STATION_CLOUD_TARGET = f"/stations/{S}/pointcloud"


def files(
    nodes: str, images: str, domains: dict[str, int], ports: dict[str, int], carrier: Carrier
) -> dict[str, str]:
    """Return what differs from the skeleton's files, of which `nodes` and `images` are two.

    `domains` and `ports` are the ROS domain and the MQTT broker's port of each node.
    """
    inventory: dict[str, Any] = yaml.safe_load(nodes)
    registry: dict[str, Any] = yaml.safe_load(images)
    registry["images"]["zenoh-bridge"] = _BRIDGE
    for node in inventory["nodes"]:
        if node["id"] in domains:  # a pattern has its own
            node["ros"]["domainId"] = domains[node["id"]]
        if carrier == "zenoh":  # a derived connection is of this type wherever it can be
            edge = {"endpoint": f"tcp/127.0.0.1:{free_port()}"}
            node["zenoh"] = edge if node["id"] == "edge" else {}
    brokers = [{"node": node, "host": "127.0.0.1", "port": port} for node, port in ports.items()]
    synchronized = override({"services": ["object-fusion"]}, values={"watcher": _WATCHER})
    return {
        "inventory/nodes.yaml": yaml.safe_dump(inventory),
        "registry/images.yaml": yaml.safe_dump(registry),
        "inventory/brokers.yaml": yaml.safe_dump(
            {"apiVersion": "demandops/v1", "kind": "Brokers", "brokers": brokers}
        ),
        "overrides/parameter-sync.yaml": synchronized,
    }


def rules(carrier: Carrier) -> str:
    """Return the text of the example's rules, changed for a type of connection.

    Zenoh renames no topics and needs no broker. So the rules for Zenoh name no broker, and each
    source topic has the name of its target topic.
    """
    text = RULES.read_text()
    if carrier == "mqtt":
        return text
    found: dict[str, Any] = yaml.safe_load(text)
    for rule in found["rules"]:
        for connection in rule["deploymentRequest"]["connections"]:
            del connection["broker_node_id"]
            connection |= {"type": _ZENOH, "source_topics": [*connection["target_topics"]]}
    return yaml.safe_dump(found)


def station_cloud(carrier: Carrier) -> str:
    return STATION_CLOUD if carrier == "mqtt" else STATION_CLOUD_TARGET


CLIENTS: dict[Carrier, int] = {"mqtt": 2, "zenoh": 1}
"""How many communication clients serve one vehicle's connection to the edge and nothing else."""


def is_client(service: str, vehicle: str, carrier: Carrier) -> bool:
    """Return whether a service is a client for this vehicle's connection to the edge alone."""
    if carrier == "zenoh":
        return service == f"zenoh-{vehicle}"
    ends = service.removeprefix("mqtt-").removeprefix("derived-")
    return ends != service and ends.startswith(f"{vehicle}-edge-")


def initial_deployment(vehicles: Collection[str]) -> dict[str, Any]:
    """Return the goal that brings every vehicle's poses to the cloud, for the detector."""
    poses = {vehicle: [POSE.format(vehicle)] for vehicle in vehicles}
    carried = [
        {
            "id": f"{vehicle}/cloud",
            "type": 1,
            "broker_node_id": "cloud",
            "requester_ids": ["operator"],
            "source_node_id": vehicle,
            "source_topics": topics,
            "target_node_id": "cloud",
            "target_topics": topics,
        }
        for vehicle, topics in poses.items()
    ]
    return {"id": "initial-deployment", "apps": [], "connections": carried, "shutdown": False}


def fusion_inputs(inside: Collection[str]) -> frozenset[str]:
    """Return the topics that the fusion must read while these vehicles are near."""
    if not inside:
        return frozenset()
    sources = {S} | ({VEHICLES[0]} & set(inside))
    lists = {f"/{source}_local_objectlist" for source in sources}
    return frozenset(lists | {f"/vehicles/{vehicle}/ego_data" for vehicle in inside})
