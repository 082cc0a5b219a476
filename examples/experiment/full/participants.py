"""The vehicles and the station as one ROS program; each is in the ROS domain of its node.

Call: `python -m examples.experiment.full.participants PLAN`.

PLAN is a JSON file with the fields of `Plan`. The vehicles publish from the program's start to its
end, also while they stand. Each line on standard input is a time, in seconds of driving. At the
first line the vehicles set off. They drive until the line's time, then stand until the next line.
When the program ends, it prints a line of JSON: the bytes of each topic since the vehicles set off,
and for how many seconds the vehicles stood.
"""

from __future__ import annotations

import json
import math
import os
import random
import select
import signal
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from pyproj import Geod
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2, PointField

from .routes import STATION, VEHICLES, Route, Track, Way

Place = tuple[float, float]

POSE = "/vehicles/{}/pose"
EGO_DATA = "/vehicles/{}/ego_data"
VEHICLE_CLOUD = "/vehicles/{}/drivers/lidar/pointcloud"
STATION_CLOUD = f"/stations/{STATION}/drivers/lidar/pointcloud"

CAMS = "/cams"

POSE_HZ = 10
POSES_PER_CLOUD = 2
TICKS_PER_POSE_OF_MANY = 2
RANGE_M = 120.0
"""How far a lidar sees, in metres."""
WITH_LIDAR = (VEHICLES[0],)
"""The vehicles that publish a point cloud, as in the paper."""

_POINT = struct.Struct("<fff")
_POINTS_PER_OBJECT = 40
_SPREAD_M = 0.4


def points_of(objects: Iterable[Place], chance: random.Random) -> list[tuple[float, float, float]]:
    """Return random points around the centre (x, y) of each object; objects are as big as cars."""
    return [
        (chance.gauss(x, _SPREAD_M), chance.gauss(y, _SPREAD_M), chance.uniform(0.2, 1.6))
        for x, y in objects
        for _ in range(_POINTS_PER_OBJECT)
    ]


def cloud_message(points: list[tuple[float, float, float]]) -> PointCloud2:
    """Return a cloud as a message in the frame `map`, without a stamp."""
    message = PointCloud2()
    message.header.frame_id = "map"
    message.height, message.width = 1, len(points)
    message.fields = [
        PointField(name=name, offset=4 * number, datatype=PointField.FLOAT32, count=1)
        for number, name in enumerate("xyz")
    ]
    message.point_step, message.row_step = _POINT.size, _POINT.size * len(points)
    message.is_dense = True
    message.data = b"".join(_POINT.pack(*point) for point in points)
    return message


@dataclass(frozen=True)
class Plan:
    """What the program plays.

    `routes` has each vehicle's way, `origin` the position of the intersection on the map, and
    `domains` the ROS domain of each node. The program records all poses that it sends; `record` is
    the file for them. `station_cloud` is the topic of the station's point cloud. With `poses_only`,
    one ROS node in the cloud's domain sends all poses, and nothing else is sent. With `on_earth`,
    the latitude and longitude of the origin, the vehicles send CAMs in place of poses: a road-side
    unit in the cloud's domain publishes all of them on one topic.
    """

    routes: tuple[Way, ...]
    origin: tuple[float, float]
    domains: dict[str, int]
    seed: int
    record: str
    station_cloud: str
    poses_only: bool = False
    on_earth: tuple[float, float] | None = None

    def write(self, file: Path) -> None:
        routes = [vars(route) for route in self.routes]
        file.write_text(json.dumps(vars(self) | {"routes": routes}))

    @classmethod
    def read(cls, file: Path) -> Plan:
        data = json.loads(file.read_text())
        routes = tuple(
            Track(**route) if "points" in route else Route(**route) for route in data.pop("routes")
        )
        return cls(routes, **data)


class Participant:
    """A vehicle or the station: a ROS node in a context of its own."""

    def __init__(self, name: str, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        self.node = Node(f"{name}_participant", context=self._context, enable_rosout=False)
        self._publishers: dict[str, Any] = {}
        self.sent: Counter[str] = Counter()

    def send(self, topic: str, message: Any, now: float) -> None:
        if hasattr(message.header, "stamp"):
            message.header.stamp.sec, message.header.stamp.nanosec = int(now), int(now % 1 * 1e9)
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(type(message), topic, 10)
        data = serialize_message(message)
        self._publishers[topic].publish(data)
        self.sent[topic] += len(data)

    def close(self) -> None:
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)


class Participants:
    def __init__(self, plan: Plan) -> None:
        self._plan, self._chance = plan, random.Random(plan.seed)
        names = (*(route.vehicle for route in plan.routes), STATION)
        if plan.poses_only:
            self._by_name = dict.fromkeys(names, Participant("crowd", plan.domains["cloud"]))
        else:
            self._by_name = {name: Participant(name, plan.domains[name]) for name in names}
            if plan.on_earth:
                self._by_name["radio"] = Participant("radio", plan.domains["cloud"])
        self._sent = Path(plan.record).open("w", buffering=1)  # noqa: SIM115 - open as long as this object
        self.set_off: float | None = None
        self.until, self.held = 0.0, 0.0
        self._elapsed, self._last = -1.0, 0.0
        self._ticks = 0

    def tick(self) -> None:
        now, elapsed = time.time(), self._pass_time()
        self._ticks += 1
        if self._plan.poses_only and self._ticks % TICKS_PER_POSE_OF_MANY:
            return
        x, y = self._plan.origin
        places = {route.vehicle: route.position(elapsed) for route in self._plan.routes}
        where = {vehicle: (x + dx, y + dy) for vehicle, (dx, dy) in places.items()}
        for route in self._plan.routes:
            if route.sends(elapsed):
                self._send_pose(route.vehicle, *where[route.vehicle], now)
        if self._ticks % POSES_PER_CLOUD == 0 and not self._plan.poses_only:
            self._send_clouds(where, elapsed, now)

    def _pass_time(self) -> float:
        """Return the seconds of driving so far; -1 before the vehicles set off."""
        passed, self._last = time.monotonic() - self._last, time.monotonic()
        if self.set_off is not None:
            driven = min(passed, max(0.0, self.until - self._elapsed))
            self._elapsed += driven
            self.held += passed - driven
        return self._elapsed

    def _send_pose(self, vehicle: str, x: float, y: float, now: float) -> None:
        message = PoseStamped()
        message.header.frame_id = "map"
        message.pose.position.x, message.pose.position.y = x, y
        message.pose.orientation.w = 1.0
        if self._plan.on_earth:
            self._by_name["radio"].send(CAMS, self._cam(vehicle, x, y), now)
        else:
            self._by_name[vehicle].send(POSE.format(vehicle), message, now)
        if not self._plan.poses_only:
            self._by_name[vehicle].send(EGO_DATA.format(vehicle), message, now)
        print(json.dumps({"at": now, "vehicle": vehicle, "x": x, "y": y}), file=self._sent)

    def _cam(self, vehicle: str, x: float, y: float) -> Any:
        """Return a vehicle's CAM; the number in its name is its station id."""
        # only `make experiment` builds the message
        from etsi_its_cam_msgs.msg import CAM

        latitude, longitude = self._plan.on_earth or (0.0, 0.0)
        azimuth, metres = math.degrees(math.atan2(x, y)), math.hypot(x, y)
        east, north, _ = Geod(ellps="WGS84").fwd(longitude, latitude, azimuth, metres)
        message = CAM()
        message.header.station_id.value = int(vehicle.removeprefix("vehicle"))
        position = message.cam.cam_parameters.basic_container.reference_position
        position.latitude.value, position.longitude.value = round(north * 1e7), round(east * 1e7)
        return message

    def _send_clouds(self, where: dict[str, Place], elapsed: float, now: float) -> None:
        seen = self._cloud(self._plan.origin, where.values())
        self._by_name[STATION].send(self._plan.station_cloud, seen, now)
        for route in self._plan.routes:
            if route.vehicle in WITH_LIDAR and route.sends(elapsed):
                others = [place for name, place in where.items() if name != route.vehicle]
                cloud = self._cloud(where[route.vehicle], others)
                self._by_name[route.vehicle].send(VEHICLE_CLOUD.format(route.vehicle), cloud, now)

    def _cloud(self, at: Place, objects: Iterable[Place]) -> Any:
        near = [place for place in objects if math.dist(place, at) <= RANGE_M]
        return cloud_message(points_of(near, self._chance))

    def go(self) -> None:
        """Let the vehicles set off, and start to count bytes anew."""
        self.set_off, self._elapsed, self._last = time.time(), 0.0, time.monotonic()
        for participant in set(self._by_name.values()):
            participant.sent.clear()

    def close(self) -> dict[str, int]:
        """Leave the ROS graphs; return each topic's bytes since :meth:`go`."""
        sent: dict[str, int] = {}
        for participant in set(self._by_name.values()):
            participant.close()
            sent |= participant.sent
        self._sent.close()
        return sent


def main(plan: Path) -> None:
    """Publish until SIGTERM or the end of standard input, then print the counts."""
    over: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: over.append(number))
    participants = Participants(Plan.read(plan))
    print(json.dumps({"ready": True}), flush=True)
    due = time.monotonic()
    while not over:
        participants.tick()
        due = max(due + 1 / POSE_HZ, time.monotonic())
        readable, _, _ = select.select([0], [], [], max(0.0, due - time.monotonic()))
        if readable:
            lines = os.read(0, 4096).split()
            if not lines:
                break
            participants.until = float(lines[-1])
            if participants.set_off is None:
                participants.go()
                print(json.dumps({"set_off": participants.set_off}), flush=True)
                due = time.monotonic()
    sent, held = participants.close(), participants.held
    print(json.dumps({"sent": sent, "held": held}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
