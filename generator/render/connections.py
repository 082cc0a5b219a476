"""Connections: two ends of MQTT, each a Deployment and a ConfigMap with mqtt_client's parameters.

Parameters as ika-rwth-aachen/mqtt_client v2.5 reads them. The client cannot drop a bridge while it
runs, so the ConfigMap's checksum stands in the pod template and a change of topics restarts it.
"""

from __future__ import annotations

import hashlib
from typing import Any

from generator import yamlio
from generator.catalog.catalog import MQTT_CLIENT_IMAGE, Catalog
from generator.plan import naming
from generator.plan.release import ConnectionEnd
from generator.render.engine import Engine


def mqtt_parameters(end: ConnectionEnd) -> dict[str, Any]:
    """Return the ROS parameter file of one end.

    Topic i of the source reaches target topic i through one MQTT topic, named by the connection
    and the source topic: names may differ between the ends.
    """
    bridge: dict[str, Any]
    if end.side == "source":
        bridge = {"ros2mqtt": {"ros_topics": list(end.topics)}}
        for source in end.topics:
            bridge["ros2mqtt"][source] = {"mqtt_topic": end.channel + source}
    else:
        bridge = {"mqtt2ros": {"mqtt_topics": [end.channel + source for source in end.topics]}}
        for source, target in end.topics.items():
            bridge["mqtt2ros"][end.channel + source] = {"ros_topic": target}
    return {
        "/**/*": {
            "ros__parameters": {
                "broker": {"host": end.broker.host, "port": end.broker.port},
                "client": {"id": end.name},
                "bridge": bridge,
            }
        }
    }


def render(end: ConnectionEnd, catalog: Catalog, engine: Engine) -> str:
    """Return the manifests of one end as one YAML text."""
    parameters = yamlio.dump(mqtt_parameters(end))
    return engine.text(
        f"connections/{end.type.name.lower()}/end.yaml.j2",
        end=end,
        node=end.node,
        selector=end.node.labels(),
        tolerations=[
            toleration.model_dump(exclude_defaults=True) for toleration in end.node.tolerations
        ],
        image=catalog.images[MQTT_CLIENT_IMAGE].reference(),
        ros_node=naming.ros_name(end.name),
        parameters=parameters,
        checksum=hashlib.sha256(parameters.encode()).hexdigest(),
    )
