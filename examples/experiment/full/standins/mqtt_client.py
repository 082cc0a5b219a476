"""A stand-in for mqtt_client: it carries serialized ROS messages over a real broker.

It reads the real parameter file. Like mqtt_client, it publishes each topic's type in a further,
retained MQTT topic for the other end of the connection.
"""

from __future__ import annotations

from typing import Any

import paho.mqtt.client as mqtt
import rclpy
from rclpy.node import Node

from .running import message_class, spin, start

TYPE_PREFIX = "mqtt_client/ros_msg_type/"
_LOOK_S = 0.1


class MqttClient(Node):
    def __init__(self) -> None:
        super().__init__("mqtt_client", automatically_declare_parameters_from_overrides=True)
        self._broker = mqtt.Client(
            mqtt.CallbackAPIVersion.VERSION2, client_id=self._value("client.id", "")
        )
        self._taken_in: dict[str, str] = {
            topic: self._value(f"bridge.mqtt2ros.{topic}.ros_topic", "")
            for topic in self._value("bridge.mqtt2ros.mqtt_topics", [])
        }
        self._senders: dict[str, Any] = {}
        self._unknown = set(self._value("bridge.ros2mqtt.ros_topics", []))
        if not (self._taken_in or self._unknown):
            raise SystemExit("no valid bridge")  # as the real mqtt_client does
        self._broker.on_connect = self._connected
        self._broker.on_message = self._take
        self._broker.connect(self._value("broker.host", ""), self._value("broker.port", 1883))
        self._broker.loop_start()
        self._look = self.create_timer(_LOOK_S, self._subscribe_known)

    def _value(self, name: str, default: Any) -> Any:
        return self.get_parameter_or(name, rclpy.Parameter(name, value=default)).value

    def _subscribe_known(self) -> None:
        """Subscribe to the topics whose types have appeared in the ROS graph."""
        known = dict(self.get_topic_names_and_types())
        for topic in sorted(self._unknown & known.keys()):
            (name,) = known[topic]
            self._give_out(topic, name)
            self._unknown.remove(topic)
        if not self._unknown:
            self._look.cancel()

    def _give_out(self, topic: str, type_name: str) -> None:
        target = self._value(f"bridge.ros2mqtt.{topic}.mqtt_topic", "")
        qos = self._value(f"bridge.ros2mqtt.{topic}.advanced.mqtt.qos", 0)
        self._broker.publish(f"{TYPE_PREFIX}{target}", type_name, qos=1, retain=True)
        self.create_subscription(
            message_class(type_name),
            topic,
            lambda data: self._broker.publish(target, data, qos=qos),
            10,
            raw=True,
        )

    def _connected(self, client: mqtt.Client, _: object, __: object, reason: Any, ___: Any) -> None:
        self.get_logger().info(f"connected: {reason}")
        for topic in self._taken_in:
            qos = self._value(f"bridge.mqtt2ros.{topic}.advanced.mqtt.qos", 0)
            client.subscribe([(topic, qos), (f"{TYPE_PREFIX}{topic}", 1)])

    def _take(self, _: object, __: object, message: mqtt.MQTTMessage) -> None:
        source = message.topic.removeprefix(TYPE_PREFIX)
        if message.topic != source:
            if source not in self._senders:
                kind = message_class(message.payload.decode())
                self._senders[source] = self.create_publisher(kind, self._taken_in[source], 10)
        elif source in self._senders:  # the type may come after the first data
            self._senders[source].publish(message.payload)

    def close(self) -> None:
        self._broker.disconnect()
        self._broker.loop_stop()


def main(given: dict[str, str]) -> None:
    ros_args = ["-r", f"__node:={given['node_name']}", "--params-file", given["params_file"]]
    start(["mqtt_client", "--ros-args", *ros_args])
    client = MqttClient()
    try:
        spin(client)
    finally:
        client.close()
