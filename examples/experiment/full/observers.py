"""ROS nodes and an MQTT client that observe the fleet, and record what happens; and a broker."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
import rclpy
from application_manager_interfaces.action import DeploymentRequest
from demandops.base.settings import DEFAULT_ACTION_NAME, DEFAULT_DEMAND_ACTION_NAME
from demandops_interfaces.action import Demand
from demandops_ros.actions import DEEP_QOS
from demandops_ros.ros_process import ExecutorThread
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from .fleet import STATION_CLOUD_TARGET
from .participants import EGO_DATA, POSE, VEHICLE_CLOUD
from .rig import ENDS_WITH_US, FUSION, PATIENCE_S, accepts, free_port, wait_until

FUSION_NODE = FUSION.replace("-", "_")
FUSED = "/edge_object_detection_fusion_global_objectlist"
TRACKS = "/edge_object_detection_fusion_global_trajectories"
_NO_INPUTS = ("/edge_object_detection_fusion_raw_objects", "/clock", "/parameter_events")
_LOOK_S = 0.1


class Observer:
    """A node that spins in a thread, in the ROS domain of one of the fleet's nodes."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node(f"observer_{domain}", context=self._context)
        self.arrivals: dict[str, list[float]] = defaultdict(list)

    def watch(self, kind: Any, topic: str) -> None:
        arrived = self.arrivals[topic]
        self.node.create_subscription(kind, topic, lambda _: arrived.append(time.time()), 10)

    def start(self) -> None:
        self._thread = ExecutorThread(self.node)

    def close(self) -> None:
        self._thread.close()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)


class EdgeObserver(Observer):
    """Records the messages at the edge, the topics that the fusion reads, and the fused objects."""

    def __init__(self, domain: int, vehicles: Iterable[str]) -> None:
        super().__init__(domain)
        self.inputs: list[tuple[float, frozenset[str]]] = [(time.time(), frozenset())]
        self.tracks: list[tuple[float, list[tuple[float, float]]]] = []
        self.bytes: Counter[str] = Counter()
        for vehicle in vehicles:
            self.watch(PoseStamped, EGO_DATA.format(vehicle))
            self._weigh(PoseStamped, EGO_DATA.format(vehicle))
            self._weigh(PointCloud2, VEHICLE_CLOUD.format(vehicle))
        self._weigh(PointCloud2, STATION_CLOUD_TARGET)
        self.watch(PoseArray, FUSED)
        self.node.create_subscription(PoseArray, TRACKS, self._take_tracks, 10)
        self.node.create_timer(_LOOK_S, self._look)

    def _weigh(self, kind: Any, topic: str) -> None:
        def count(data: bytes) -> None:
            self.bytes[topic] += len(data)

        self.node.create_subscription(kind, topic, count, 10, raw=True)

    def _take_tracks(self, message: PoseArray) -> None:
        places = [(pose.position.x, pose.position.y) for pose in message.poses]
        self.tracks.append((time.time(), places))

    def _look(self) -> None:
        """Record the topics to which the fusion subscribes, if they have changed."""
        found: list[Any] = []
        if FUSION_NODE in self.node.get_node_names():
            with suppress(Exception):  # the fusion may leave meanwhile
                found = self.node.get_subscriber_names_and_types_by_node(FUSION_NODE, "/")
        topics = frozenset(name for name, _ in found if name not in _NO_INPUTS)
        if topics != self.inputs[-1][1]:
            self.inputs.append((time.time(), topics))


class CloudObserver(Observer):
    """Records the poses that arrive in the cloud, and the stages of each demand."""

    def __init__(self, domain: int, vehicles: Iterable[str] = ()) -> None:
        super().__init__(domain)
        self.stages: dict[bytes, dict[str, tuple[float, str]]] = defaultdict(dict)
        for vehicle in vehicles:
            self.watch(PoseStamped, POSE.format(vehicle))
        actions = {DEFAULT_ACTION_NAME: DeploymentRequest, DEFAULT_DEMAND_ACTION_NAME: Demand}
        for name, action in actions.items():
            kind, topic = action.Impl.FeedbackMessage, f"{name}/_action/feedback"
            self.node.create_subscription(kind, topic, self._take_feedback, DEEP_QOS)

    def _take_feedback(self, message: Any) -> None:
        stage, _, rest = message.feedback.message.partition(" ")
        self.stages[bytes(message.goal_id.uuid)].setdefault(stage, (time.time(), rest.strip()))

    def commits(self) -> dict[str, dict[str, float]]:
        """Return the time of each stage of each committed demand, by commit and stage."""
        return {
            stages["committed"][1]: {stage: at for stage, (at, _) in stages.items()}
            for stages in list(self.stages.values())
            if "committed" in stages
        }


# ---- MQTT ----


class Broker:
    """A mosquitto, and a client that counts the bytes of each topic."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.bytes: Counter[str] = Counter()
        program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
        assert program, "mosquitto is missing; run `setup/system e2e` as root to install it"
        configuration = folder / "mosquitto.conf"
        configuration.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\n")
        with (folder / "mosquitto.log").open("w") as log:
            self._process = subprocess.Popen(
                [*ENDS_WITH_US, program, "-c", str(configuration)], stdout=log, stderr=log
            )
        self._counter = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self._counter.on_connect = lambda client, *_: client.subscribe("#")
        self._counter.on_message = self._count
        answers = accepts(self.port)
        wait_until(lambda: answers() is None or self._process.poll() is not None, "mosquitto")
        self._counter.connect("127.0.0.1", self.port)
        self._counter.loop_start()

    def _count(self, _: object, __: object, message: Any) -> None:
        self.bytes[message.topic] += len(message.payload)

    def close(self) -> None:
        self._counter.disconnect()
        self._counter.loop_stop()
        self._process.terminate()
        self._process.wait(PATIENCE_S)
