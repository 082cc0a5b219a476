"""MQTT connections: each end is an mqtt_client with its ROS parameters.

Parameters as ika-rwth-aachen/mqtt_client v2.5 reads them. The client cannot drop a bridge while it
runs, so the pod template has a checksum of the parameters and a change of topics restarts the pod.

The parameters do not contain a broker's user name and password: the pod reads them from a Secret
(``docs/decisions/0009-credentials-of-brokers.md``).
"""

from __future__ import annotations

from typing import Any

from demandops import naming, strict_yaml
from demandops.config.config import MQTT_CLIENT_IMAGE, Config
from demandops.config.inventory import Broker
from demandops.connections.route import Route
from demandops.plan.release import MqttEnd
from demandops.render.connections import client_pod, client_schema
from demandops.render.engine import Engine

CA_FILE = "/tls/ca.crt"
"""The path where the certificate of the broker's authority is mounted."""

COMPOSE = """\
import json, os, pathlib
os.umask(0o077)
user, password = (
    pathlib.Path("/secret", name).read_text().rstrip("\\n") for name in ("user", "password")
)
broker = {"broker": {"user": user, "pass": password}}
text = json.dumps({"/**/*": {"ros__parameters": broker}}, ensure_ascii=False)
pathlib.Path("/credentials/params.yaml").write_text(text)
"""
"""The init container's program: it turns the Secret into a ROS parameter file in memory."""


def parameters(end: MqttEnd) -> dict[str, Any]:
    """Return the content of one end's ROS parameter file.

    Each ROS topic has one MQTT topic, named after the connection and the source topic: a topic's
    name may differ between the ends.
    """
    bridge: dict[str, Any] = {}
    read = {
        route.read_topic: (name, route) for name, route in end.topics.items() if end.reads(route)
    }
    written = {name: route for name, route in end.topics.items() if not end.reads(route)}
    if read:
        bridge["ros2mqtt"] = {"ros_topics": sorted(read)}
        for topic, (name, route) in sorted(read.items()):
            bridge["ros2mqtt"][topic] = {
                "mqtt_topic": end.channel + name,
                **_options(route, retained=route.retained),
            }
    if written:
        bridge["mqtt2ros"] = {"mqtt_topics": [end.channel + name for name in written]}
        for name, route in written.items():
            bridge["mqtt2ros"][end.channel + name] = {
                "ros_topic": route.written_topic,
                **_options(route),
            }
    return {
        "/**/*": {
            "ros__parameters": {
                "broker": _broker(end.broker),
                "client": {"id": end.name},
                "bridge": bridge,
            }
        }
    }


def _broker(broker: Broker) -> dict[str, Any]:
    data: dict[str, Any] = {"host": broker.host, "port": broker.port}
    if broker.tls:
        data["tls"] = {"enabled": True}
        if broker.tls.ca_secret:
            data["tls"]["ca_certificate"] = CA_FILE
    return data


def _options(route: Route, *, retained: bool = False) -> dict[str, Any]:
    """Return a topic's further parameters, without those that have the client's default."""
    options: dict[str, Any] = {}
    if route.primitive:
        options["primitive"] = True
    if route.type:
        options["ros_type"] = route.type
    ros: dict[str, Any] = {"queue_size": route.queue} if route.queue else {}
    qos = {"reliability": route.reliability, "durability": route.durability}
    qos = {name: value for name, value in qos.items() if value}
    ros |= {"qos": qos} if qos else {}
    mqtt: dict[str, Any] = {"qos": route.qos} if route.qos else {}
    mqtt |= {"retained": True} if retained else {}
    advanced = {name: part for name, part in (("ros", ros), ("mqtt", mqtt)) if part}
    return {**options, "advanced": advanced} if advanced else options


def render(end: MqttEnd, config: Config, engine: Engine) -> str:
    """Return the manifests of one end as one YAML text."""
    data = parameters(end)
    client_schema.check("mqtt", data, end.name)
    text = strict_yaml.dump(data)
    return engine.text(
        "connections/mqtt/end.yaml.j2",
        end=end,
        ros_node=naming.ros_name(end.name),
        parameters=text,
        checksum=client_pod.checksum(text),
        tls=end.broker.tls,
        credentials=end.broker.credentials,
        compose=COMPOSE,
        **client_pod.context(end, MQTT_CLIENT_IMAGE, config),
    )
