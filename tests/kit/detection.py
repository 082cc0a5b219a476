"""Rules, observations and ROS bags of vehicles' poses for tests of the event detector."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from demandops.base import strict_yaml
from demandops.detect import rule_file
from demandops.detect.event_engine import Event, EventEngine, Observation, State
from demandops.detect.rule_file import RuleFile
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

POSE = "geometry_msgs/msg/PoseStamped"
SOURCES = {
    "cars": {"topic": "/cars/{entity}/pose", "type": POSE, "timeout": "3s"},
    "bikes": {"topic": "/bikes/{entity}/pose", "type": POSE, "timeout": "2s"},
    "batteries": {"topic": "/cars/{entity}/battery", "type": "sensor_msgs/msg/BatteryState"},
}


def demand(**fields: Any) -> dict[str, Any]:
    return {"demand": "{rule}/{entity}", "requesters": ["{entity}"]} | fields


def rule(name: str, **fields: Any) -> dict[str, Any]:
    """Return a rule; it has a default ``demand`` unless it has a ``deploymentRequest``."""
    subjects = ["{rule}"]
    subjects += [] if {"count", "schedule"} & set(fields) else ["{entity}"]
    subjects += ["{other}"] if "together" in fields else []
    own = {"demand": demand(demand="/".join(subjects), requesters=["r"])}
    return {"name": name} | ({} if "deploymentRequest" in fields else own) | fields


def text_of(*rules: dict[str, Any], sources: dict[str, Any] = SOURCES, **file: Any) -> str:
    head = {"apiVersion": "demandops/v1", "kind": "DetectorRules"}
    return strict_yaml.dump({**head, **file, "sources": sources, "rules": [*rules]})


def file_of(*rules: dict[str, Any], sources: dict[str, Any] = SOURCES) -> RuleFile:
    return rule_file.read(text_of(*rules, sources=sources), "rules.yaml")


def at(time: float, entity: str, x: float, y: float = 0.0, source: str = "cars") -> Observation:
    return Observation(source, entity, time, (x, y))


class Run:
    def __init__(
        self, *rules: dict[str, Any], now: float = 0.0, sources: dict[str, Any] = SOURCES
    ) -> None:
        self.engine = EventEngine(file_of(*rules, sources=sources))
        self.state: State = self.engine.start(now)

    def step(self, now: float, *observations: Observation) -> list[Event]:
        self.state, events = self.engine.step(self.state, observations, now)
        return [*events]

    def told(self, now: float, *observations: Observation) -> list[tuple[Any, ...]]:
        """Advance the engine; return the told events as (rule, entities, start or stop, time)."""
        return [
            (event.rule, " ".join(event.subjects), "start" if event.starts else "stop", event.at)
            for event in self.step(now, *observations)
        ]


# ---- bags ----

_STRING = "std_msgs/msg/String"
_TYPES = get_typestore(Stores.ROS2_KILTED)


def write_bag(
    path: Path,
    poses: Iterable[tuple[float, str, float, float]],
    plugin: StoragePlugin = StoragePlugin.MCAP,
    texts: Iterable[tuple[float, str, str]] = (),
) -> None:
    """Write a new bag of poses in the order of time, after the texts; times are in seconds."""
    new = _TYPES.types
    topics: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        for at, topic, text in texts:
            other = writer.add_connection(topic, _STRING, typestore=_TYPES)
            data = _TYPES.serialize_cdr(new[_STRING](text), _STRING)
            writer.write(other, round(at * 1e9), data)
        for at, vehicle, x, y in poses:
            nanoseconds = round(at * 1e9)
            if vehicle not in topics:
                topic = f"/vehicles/{vehicle}/pose"
                topics[vehicle] = writer.add_connection(topic, POSE, typestore=_TYPES)
            stamp = new["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
            head = new["std_msgs/msg/Header"](stamp, "map")
            turned = new["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            place = new["geometry_msgs/msg/Point"](x, y, 0.0)
            pose = new[POSE](head, new["geometry_msgs/msg/Pose"](place, turned))
            writer.write(topics[vehicle], nanoseconds, _TYPES.serialize_cdr(pose, POSE))
