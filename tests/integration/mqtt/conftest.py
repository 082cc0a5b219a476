"""Fixtures: a real mosquitto on loopback, and a pod's configuration as its containers see it."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
import pytest
import rclpy
import yaml
from rclpy.node import Node

from tests.e2e.rig import pki
from tests.e2e.rig.net import free_port
from tests.kit.limits import PATIENCE_S
from tests.kit.rig import wait_until

USER = "fleet 007"
PASSWORD = "12345\"'{}#\\ é%"  # noqa: S105 - of a broker that lives as long as the test
"""A password with characters that would break YAML, a shell or a command line without quotes."""


def _program(name: str) -> str:
    found = shutil.which(name) or shutil.which(name, path="/usr/sbin:/usr/local/sbin")
    assert found, f"{name} is missing; run `setup/system test` as root to install it"
    return found


@dataclass(frozen=True)
class Broker:
    """A broker that accepts only TLS connections with user and password."""

    port: int
    authority: Path

    def inventory(self) -> str:
        entry = {
            "node": "edge",
            "host": "127.0.0.1",
            "port": self.port,
            "tls": {"caSecret": "broker-ca"},
            "credentials": {"secret": "broker-login"},
        }
        return yaml.safe_dump({"apiVersion": "demandops/v1", "kind": "Brokers", "brokers": [entry]})


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    folder = tmp_path_factory.mktemp("broker")
    keys = pki.make(folder / "pki")
    passwords = folder / "passwords"
    subprocess.run(
        [_program("mosquitto_passwd"), "-c", "-b", str(passwords), USER, PASSWORD],
        check=True,
    )
    port = free_port()
    configuration = folder / "mosquitto.conf"
    configuration.write_text(
        f"listener {port} 127.0.0.1\nallow_anonymous false\npassword_file {passwords}\n"
        f"cafile {keys.authority}\ncertfile {keys.server_certificate}\n"
        f"keyfile {keys.server_key}\nuser root\n"
    )
    log = folder / "log"
    with log.open("w") as out:
        process = subprocess.Popen(
            [_program("mosquitto"), "-c", str(configuration)], stdout=out, stderr=out
        )

    def listens() -> bool:
        assert process.poll() is None, log.read_text()
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    try:
        wait_until(listens, "mosquitto listens")
        yield Broker(port, keys.authority)
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


class Pod:
    """The pod of one end of a connection, without a cluster.

    Its volumes are folders, and its init containers run as processes.
    """

    def __init__(self, manifest: str, secrets: dict[str, dict[str, str]], folder: Path) -> None:
        """Write the files of the volumes and run the init containers."""
        config, self.deployment = yaml.safe_load_all(manifest)
        self._spec = self.deployment["spec"]["template"]["spec"]
        self.folder = folder
        for volume in self._spec["volumes"]:
            place = folder / volume["name"]
            place.mkdir(parents=True)
            if "configMap" in volume:
                files = config["data"]
            elif "secret" in volume:
                held = secrets[volume["secret"]["secretName"]]
                files = {item["path"]: held[item["key"]] for item in volume["secret"]["items"]}
            else:
                files = {}
            for name, text in files.items():
                (place / name).write_text(text)
        for container in self._spec.get("initContainers", ()):
            command = [self._on_host(container, part) for part in container["command"][1:]]
            subprocess.run([sys.executable, *command], timeout=PATIENCE_S, check=True)

    def _on_host(self, container: dict[str, Any], text: str) -> str:
        """Return ``text`` with the container's mount paths replaced by its volumes' folders."""
        for mount in container["volumeMounts"]:
            text = text.replace(f"{mount['mountPath']}", str(self.folder / mount["name"]))
        return text

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """The client's parameters, as the real rcl reads them from the launch arguments."""
        (container,) = self._spec["containers"]
        arguments = container["args"]
        assert arguments[:4] == ["ros2", "launch", "mqtt_client", "standalone.launch.ros2.xml"]
        given = dict(argument.split(":=") for argument in arguments[4:])
        file, context = self._on_host(container, given["params_file"]), rclpy.Context()
        ros_args = ["-r", f"__node:={given['node_name']}", "--params-file", file]
        rclpy.init(args=["--ros-args", *ros_args], context=context)
        node = Node("x", context=context, automatically_declare_parameters_from_overrides=True)
        assert node.get_name() == self.deployment["metadata"]["name"].replace("-", "_")
        found: dict[str, Any] = {
            name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()
        }
        node.destroy_node()
        context.try_shutdown()
        found["broker.tls.ca_certificate"] = self._on_host(
            container, found["broker.tls.ca_certificate"]
        )
        return found


class Client:
    """A stand-in for mqtt_client that does at the broker only what its parameters require."""

    def __init__(self, parameters: dict[str, Any]) -> None:
        """Connect, subscribe to the MQTT topics of this end, and collect the messages."""
        self.parameters = parameters
        self.arrived: list[tuple[str, bytes, int, bool]] = []
        self.acknowledged: list[int] = []
        self._client = mqtt.Client(
            mqtt.CallbackAPIVersion.VERSION2, client_id=parameters["client.id"]
        )
        self._client.username_pw_set(parameters["broker.user"], parameters["broker.pass"])
        if parameters["broker.tls.enabled"]:
            self._client.tls_set(ca_certs=parameters["broker.tls.ca_certificate"])
        self._client.on_message = self._take
        self._client.on_subscribe = lambda *_: self.acknowledged.append(1)
        self.reason = ""
        self._client.on_connect = self._connected
        self._client.connect(parameters["broker.host"], parameters["broker.port"])
        self._client.loop_start()
        wait_until(lambda: bool(self.reason), "the broker answers")

    def _connected(self, client: mqtt.Client, _: object, __: object, reason: Any, ___: Any) -> None:
        topics = self.parameters.get("bridge.mqtt2ros.mqtt_topics", [])
        for topic in topics if not reason.is_failure else []:
            qos = self.parameters.get(f"bridge.mqtt2ros.{topic}.advanced.mqtt.qos", 0)
            client.subscribe(topic, qos)
        self.reason = str(reason)

    def _take(self, _: object, __: object, message: mqtt.MQTTMessage) -> None:
        self.arrived.append((message.topic, message.payload, message.qos, message.retain))

    def publish(self, ros_topic: str, payload: bytes) -> None:
        """Publish to the broker what the client would publish for a message of a ROS topic."""
        prefix = f"bridge.ros2mqtt.{ros_topic}"
        sent = self._client.publish(
            self.parameters[f"{prefix}.mqtt_topic"],
            payload,
            qos=self.parameters.get(f"{prefix}.advanced.mqtt.qos", 0),
            retain=self.parameters.get(f"{prefix}.advanced.mqtt.retained", False),
        )
        sent.wait_for_publish(PATIENCE_S)
        assert sent.is_published()

    def ready(self) -> None:
        topics = self.parameters.get("bridge.mqtt2ros.mqtt_topics", [])
        wait_until(lambda: len(self.acknowledged) == len(topics), "all is subscribed to")

    def named(self) -> list[tuple[str, bytes, int, bool]]:
        """Return the messages that arrived, by their ROS topics."""
        name = "bridge.mqtt2ros.{}.ros_topic"
        return sorted((self.parameters[name.format(topic)], *more) for topic, *more in self.arrived)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()
