"""Zenoh connections: each node has one zenoh-bridge-ros2dds for all of them.

Configuration as eclipse-zenoh/zenoh-plugin-ros2dds 1.10 reads it. The bridge reads it only at the
start, so the pod template has its checksum.
"""

from __future__ import annotations

import json
import re
from typing import Any

from demandops import naming
from demandops.config.config import ZENOH_BRIDGE_IMAGE, Config
from demandops.plan.release import Bridge
from demandops.render.connections import client_pod, client_schema
from demandops.render.engine import Engine


def configuration(bridge: Bridge) -> dict[str, Any]:
    """Return the configuration of a node's bridge.

    ``allow`` lists the topics that pass; a missing list lets none pass. Multicast scouting is off:
    Git says which bridges connect.
    """
    lists = {"publishers": bridge.publishers, "subscribers": bridge.subscribers}
    ros: dict[str, Any] = {
        "nodename": naming.ros_name(bridge.name),
        "domain": bridge.node.ros.domain_id,
        "allow": {
            name: [_exactly(topic) for topic in topics] for name, topics in lists.items() if topics
        },
    }
    if bridge.rates:
        ros["pub_max_frequencies"] = [
            f"{_exactly(topic)}={rate:g}" for topic, rate in bridge.rates.items()
        ]
    return {
        "mode": "router",
        "connect": {"endpoints": list(bridge.connect)},
        "listen": {"endpoints": list(bridge.listen)},
        "scouting": {"multicast": {"enabled": False}},
        "plugins": {"ros2dds": ros},
    }


def _exactly(topic: str) -> str:
    """Return the regular expression that matches only this topic's name."""
    return f"^{re.escape(topic)}$"


def render(bridge: Bridge, config: Config, engine: Engine) -> str:
    """Return the manifests of a node's bridge as one YAML text."""
    data = configuration(bridge)
    client_schema.check("zenoh", data, bridge.name)
    text = json.dumps(data, indent=2, ensure_ascii=False) + "\n"
    return engine.text(
        "connections/zenoh/bridge.yaml.j2",
        bridge=bridge,
        configuration=text,
        checksum=client_pod.checksum(text),
        **client_pod.context(bridge, ZENOH_BRIDGE_IMAGE, config),
    )
