"""A plain script that tells what the rules of `examples/experiment/` demand for given poses.

The script shares no code with the event detector, so that a test can compare the two.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from demandops.detect import rule_file
from demandops_ros.detector.replay import RecordedBag

from .routes import LEAD_S, VEHICLES, Track, Way

RULES = Path(__file__).resolve().parents[1] / "rules.yaml"


@dataclass(frozen=True)
class Near:
    """The condition under which a vehicle is near `point`.

    A vehicle becomes near at a distance of `start` metres. It stays near until it is more than
    `stop` metres away, or silent for `timeout` seconds.
    """

    point: tuple[float, float]
    start: float
    stop: float
    timeout: float

    @classmethod
    def read(cls, rules: Path = RULES) -> Near:
        """Return the condition that all rules of a file have in common."""
        data: dict[str, Any] = yaml.safe_load(rules.read_text())
        (source,) = data["sources"].values()
        (near,) = {json.dumps(rule["near"], sort_keys=True) for rule in data["rules"]}
        found = json.loads(near)
        point = found["point"]["x"], found["point"]["y"]
        return cls(point, found["start"], found["stop"], float(source["timeout"].removesuffix("s")))


@dataclass(frozen=True)
class Pose:
    at: float
    vehicle: str
    x: float
    y: float


@dataclass(frozen=True)
class Event:
    at: float
    vehicle: str
    joins: bool

    def __str__(self) -> str:
        return f"{self.vehicle} {'joins' if self.joins else 'leaves'}"


def poses_in(record: Path) -> list[Pose]:
    return [Pose(**json.loads(line)) for line in record.read_text().splitlines()]


def predicted(ways: Iterable[Way], near: Near, until: float) -> list[Pose]:
    """Return the poses of a drive without stops, ten per second for each vehicle."""
    x0, y0 = near.point
    ways = tuple(ways)
    places = (
        (tick / 10, way.vehicle, way.position(tick / 10))
        for tick in range(int(until * 10))
        for way in ways
        if way.sends(tick / 10)
    )
    return [Pose(at, vehicle, x0 + x, y0 + y) for at, vehicle, (x, y) in places]


def causes(poses: Iterable[Pose], near: Near, until: float) -> list[float]:
    """Return the times of the poses that cause events, in order.

    The cause of an event is the vehicle's pose at the time of the event. If a vehicle leaves
    because it is silent, the cause is its last pose.
    """
    poses = list(poses)
    sent = {(pose.at, pose.vehicle) for pose in poses}
    events = events_of(poses, near, until)
    return sorted(
        event.at if (event.at, event.vehicle) in sent else event.at - near.timeout
        for event in events
    )


def events_of(poses: Iterable[Pose], near: Near, until: float) -> list[Event]:
    return sorted(_events(list(poses), near, until), key=lambda event: event.at)


def _events(poses: list[Pose], near: Near, until: float) -> Iterator[Event]:
    by_vehicle: dict[str, list[Pose]] = {}
    for pose in poses:
        by_vehicle.setdefault(pose.vehicle, []).append(pose)
    for vehicle in sorted(by_vehicle):
        is_near, last = False, 0.0
        for pose in by_vehicle[vehicle]:
            distance, last = math.dist((pose.x, pose.y), near.point), pose.at
            if is_near != (distance <= (near.stop if is_near else near.start)):
                is_near = not is_near
                yield Event(pose.at, vehicle, is_near)
        if is_near and last + near.timeout < until:
            yield Event(last + near.timeout, vehicle, False)


# ---- recorded poses ----


def bag_tracks(bag: Path, near: Near) -> tuple[Track, ...]:
    """Return the track of each vehicle in a bag, or end with the reason why it cannot be played."""
    rules = rule_file.read(RULES.read_text(), RULES.name)
    points: dict[str, list[tuple[float, float, float]]] = {}
    first: float | None = None
    with closing(RecordedBag(bag, rules)) as reader:
        for one in reader.observations():
            if one.position is not None:
                first = one.at if first is None else first
                x, y = one.position[0] - near.point[0], one.position[1] - near.point[1]
                points.setdefault(one.entity, []).append((one.at - first + LEAD_S, x, y))
    if others := points.keys() - set(VEHICLES):
        raise SystemExit(
            f"{bag}: has poses of {', '.join(sorted(others))}; the experiment has nodes for "
            f"{', '.join(VEHICLES)} only, so rename the topics"
        )
    found = tuple(Track(vehicle, tuple(points[vehicle])) for vehicle in sorted(points))
    for track in found:
        if math.hypot(*track.position(0.0)) <= near.stop:
            raise SystemExit(
                f"{bag}: {track.vehicle} begins within {near.stop:g} m of the station; start the "
                "recording earlier"
            )
    return found
