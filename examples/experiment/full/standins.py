"""Stand-ins for the programs in the pods, and the folder that takes the place of every image.

They take the commands, parameters and topics of the real programs.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import struct
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import rclpy
from demandops_ros.ros_process import ExecutorThread, StopSignals
from geometry_msgs.msg import Pose, PoseArray, PoseStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2

PROGRAMS = ("ros2", "zenoh-bridge-ros2dds", "demandops")


def image(folder: Path) -> Path:
    """Fill the containers' working directory with the stand-in programs; return the directory."""
    setup = folder / "install" / "setup.bash"
    setup.parent.mkdir(exist_ok=True)
    setup.write_text(f'PATH="{folder}:$PATH"\n')
    for name in PROGRAMS:
        program = folder / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {__name__} {name} "$@"\n')
        program.chmod(0o755)
    return folder


def message_class(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def start(args: list[str] | None = None, domain: int | None = None) -> None:
    """Initialize ROS without its own signal handlers, because :func:`spin` handles the signals."""
    rclpy.init(args=args or [], domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)


def spin(node: Node) -> None:
    """Run a node's callbacks until Ctrl-C or SIGTERM, then shut ROS down."""
    with StopSignals() as signals:
        thread = ExecutorThread(node)
        signals.wait()
        thread.close()
    rclpy.try_shutdown()


# ---- the detection: a point cloud becomes a list of objects ----

_REACH_M = 3.0
_FEWEST_POINTS = 5


def cluster(points: Iterable[tuple[float, float, float]]) -> list[tuple[float, float]]:
    """Return the centres of groups of nearby points, except groups with few points."""
    groups: list[tuple[float, float, int]] = []  # sums of x and y, and how many
    for x, y, _ in points:
        for index, (sum_x, sum_y, count) in enumerate(groups):
            if abs(sum_x / count - x) < _REACH_M and abs(sum_y / count - y) < _REACH_M:
                groups[index] = (sum_x + x, sum_y + y, count + 1)
                break
        else:
            groups.append((x, y, 1))
    return [(x / count, y / count) for x, y, count in groups if count >= _FEWEST_POINTS]


def pose_at(x: float, y: float) -> Pose:
    """Return the pose of an object whose heading is unknown."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.orientation.w = x, y, 1.0
    return pose


def detect(given: dict[str, str]) -> None:
    start()
    node = Node(given["node_name"])
    sender = node.create_publisher(PoseArray, given["object_list_topic"], 10)

    def take(cloud: PointCloud2) -> None:
        points = struct.iter_unpack("<fff", bytes(cloud.data))
        objects = [pose_at(x, y) for x, y in cluster(points)]
        sender.publish(PoseArray(header=cloud.header, poses=objects))

    node.create_subscription(PointCloud2, given["point_cloud_topic"], take, 10)
    spin(node)


# ---- the fusion: object lists and ego data become one list ----

_PERIOD_S = 0.2
_SAME_M = 3.0
_INPUTS = {
    "additional_inputs.topics_egodata": PoseStamped,
    "additional_inputs.topics_objectlist": PoseArray,
}


class Fusion(Node):
    """Fuses the newest message of each input, and publishes all objects and the vehicles' tracks.

    Its inputs can change while it runs. It takes times from the messages and a steady clock, not
    from ROS, because the chart sets `use_sim_time` by default, and no simulated clock runs here.
    """

    def __init__(self, given: dict[str, str]) -> None:
        super().__init__(given["node_name"])
        self._newest: dict[str, Any] = {}
        self._inputs: dict[str, Any] = {}
        self._objects = self.create_publisher(PoseArray, given["fused_object_lists_topic"], 10)
        self._tracks = self.create_publisher(PoseArray, given["fused_trajectories_topic"], 10)
        self._subscribe(given["raw_object_lists_topic"], PoseArray)
        self.declare_parameter("additional_inputs.mode", "dynamic")
        self.declare_parameter("additional_inputs.length", 0)
        for name in _INPUTS:
            self.declare_parameter(name, [""])
        self.add_on_set_parameters_callback(self._follow)
        self.create_timer(_PERIOD_S, self._fuse, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _follow(self, changes: list[Parameter]) -> SetParametersResult:
        for change in changes:
            if change.name not in _INPUTS:
                continue
            kind = _INPUTS[change.name]
            wanted = {topic for topic in change.value if topic}
            known = {topic for topic, entry in self._inputs.items() if entry.msg_type is kind}
            for topic in known - wanted:
                self.destroy_subscription(self._inputs.pop(topic))
                self._newest.pop(topic, None)
            for topic in wanted - known:
                self._inputs[topic] = self._subscribe(topic, kind)
        return SetParametersResult(successful=True)

    def _subscribe(self, topic: str, kind: Any) -> Any:
        return self.create_subscription(
            kind, topic, lambda message: self._newest.__setitem__(topic, message), 10
        )

    def _fuse(self) -> None:
        if not self._newest:
            return
        messages = list(self._newest.values())
        newest = max(messages, key=lambda m: (m.header.stamp.sec, m.header.stamp.nanosec))
        egos = [message.pose for message in messages if isinstance(message, PoseStamped)]
        seen = list(egos)
        for message in messages:
            if isinstance(message, PoseArray):
                seen += [pose for pose in message.poses if not _is_among(pose, seen)]
        places = [pose_at(pose.position.x, pose.position.y) for pose in seen]
        self._objects.publish(PoseArray(header=newest.header, poses=places))
        self._tracks.publish(PoseArray(header=newest.header, poses=egos))


def _is_among(pose: Any, others: list[Any]) -> bool:
    return any(
        abs(pose.position.x - other.position.x) < _SAME_M
        and abs(pose.position.y - other.position.y) < _SAME_M
        for other in others
    )


def fuse(given: dict[str, str]) -> None:
    start()
    spin(Fusion(given))


# ---- mqtt_client: it carries serialized ROS messages over a real broker ----

TYPE_PREFIX = "mqtt_client/ros_msg_type/"
_LOOK_S = 0.1


class MqttClient(Node):
    """Reads the real parameter file.

    Like mqtt_client, it publishes each topic's type in a further, retained MQTT topic for the other
    end of the connection.
    """

    def __init__(self) -> None:
        import paho.mqtt.client as mqtt

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

    def _connected(self, client: Any, _: object, __: object, reason: Any, ___: Any) -> None:
        self.get_logger().info(f"connected: {reason}")
        for topic in self._taken_in:
            qos = self._value(f"bridge.mqtt2ros.{topic}.advanced.mqtt.qos", 0)
            client.subscribe([(topic, qos), (f"{TYPE_PREFIX}{topic}", 1)])

    def _take(self, _: object, __: object, message: Any) -> None:
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


def carry_by_mqtt(given: dict[str, str]) -> None:
    ros_args = ["-r", f"__node:={given['node_name']}", "--params-file", given["params_file"]]
    start(["mqtt_client", "--ros-args", *ros_args])
    client = MqttClient()
    try:
        spin(client)
    finally:
        client.close()


# ---- zenoh-bridge-ros2dds: it carries serialized ROS messages over the real Zenoh ----


class Bridge(Node):
    """The bridge of one node, for all connections of the node.

    It reads the real configuration. The real bridge is a plugin that Zenoh's Python wheels lack.
    Unlike the real bridge, the stand-in sends a topic's type with each message.
    """

    def __init__(self, plugin: dict[str, Any], session: Any) -> None:
        super().__init__(plugin["nodename"])
        self._session = session
        self._given, self._taken = (
            re.compile("|".join(plugin["allow"].get(ends, ["(?!)"])))
            for ends in ("publishers", "subscribers")
        )
        self._readers: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}
        self._arrivals = session.declare_subscriber("**", self._take)
        self.create_timer(_LOOK_S, self._subscribe_new)

    def _subscribe_new(self) -> None:
        """Subscribe to the new topics in the ROS graph that the configuration allows to be sent."""
        for topic, (kind, *_) in self.get_topic_names_and_types():
            if topic not in self._readers and self._given.search(topic):
                self._readers[topic] = self.create_subscription(
                    message_class(kind),
                    topic,
                    lambda data, t=topic, k=kind: self._session.put(t[1:], data, attachment=k),
                    10,
                    raw=True,
                )

    def _take(self, sample: Any) -> None:
        topic = f"/{sample.key_expr}"
        if not self._taken.search(topic):
            return
        if topic not in self._writers:
            kind = message_class(sample.attachment.to_string())
            self._writers[topic] = self.create_publisher(kind, topic, 10)
        self._writers[topic].publish(sample.payload.to_bytes())


def carry_by_zenoh(arguments: list[str]) -> None:
    import zenoh

    parser = argparse.ArgumentParser()
    parser.add_argument("-c", dest="config", type=Path, required=True)
    config = json.loads(parser.parse_args(arguments).config.read_text())
    plugin = config.pop("plugins")["ros2dds"]
    start(domain=plugin["domain"])
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        spin(Bridge(plugin, session))


# ---- which command runs which ----

_LAUNCHED = {
    ("point_cloud_object_detection", "point_cloud_object_detection.launch.py"): detect,
    ("object_fusion", "fusion_function_launch.py"): fuse,
    ("mqtt_client", "standalone.launch.ros2.xml"): carry_by_mqtt,
}
"""For each launch file of the reference's images, what stands in for it."""
OURS = ("demandops_ros", "parameter_sync.launch.xml")


def main(program: str, *arguments: str) -> None:
    """Run our own program or an installed node, or the stand-in for one of the reference."""
    if program == "zenoh-bridge-ros2dds":
        carry_by_zenoh([*arguments])
        return
    if program == "demandops":
        _become("-m", "demandops.cli.main", *arguments)
    command, package, file, *rest = arguments
    if command == "run":
        _become(str(Path.cwd() / package / file), *rest)
    assert command == "launch", command
    given = dict(argument.split(":=", 1) for argument in rest)
    if (package, file) == OURS:
        # what the launch file runs; ROS's `launch` itself does not come as a Python wheel
        ros_args = ["-r", f"__node:={given['node_name']}", "--params-file", given["params"]]
        _become("-m", "demandops.cli.main", "parameter-sync", "--ros-args", *ros_args)
    _LAUNCHED[package, file](given)


def _become(*arguments: str) -> NoReturn:
    os.execv(sys.executable, [sys.executable, *arguments])  # noqa: S606 - no shell on purpose


if __name__ == "__main__":
    main(*sys.argv[1:])
