"""Requests as plain data: goals of the reference's action and demands in DemandOps' own format."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tests.kit import plain_yaml

Goal = dict[str, Any]
Item = dict[str, Any]

Topic = tuple[str, str]
"""The name of a topic, and the node that publishes it."""

APP = "edge/object_detection_fusion"
CLOUD: Topic = ("/vehicles/vehicle00/drivers/lidar/pointcloud", "vehicle00")
"""The usual point cloud of vehicle00 in the skeleton's inventory."""
EGO: Topic = ("/vehicles/vehicle00/ego_data", "vehicle00")
STATION_CLOUD: Topic = ("/stations/station00/pointcloud", "station00")

EXPERIMENT = sorted((Path(__file__).parents[2] / "examples" / "experiment").glob("[1-8]-*.yaml"))
"""The files of the paper's eight demands, in order."""


def application(
    id: str = APP,
    *,
    node: str = "edge",
    who: Sequence[str] = ("vehicle00",),
    ego: Iterable[Topic] = (),
    clouds: Iterable[Topic] = (CLOUD,),
    type: int = 1,
) -> Item:
    return {
        "header": {"id": id, "node_id": node},
        "type": type,
        "object_detection_fusion_app": {
            "requester_ids": list(who),
            "ego_data_topics": [input_topic(topic) for topic in ego],
            "pointcloud_topics": [input_topic(topic) for topic in clouds],
        },
    }


def input_topic(topic: Topic) -> dict[str, str]:
    return {"topic_name": topic[0], "source_node_id": topic[1]}


def connection(
    id: str = "vehicle00/edge",
    *,
    who: Sequence[str] = ("vehicle00",),
    ends: tuple[str, str] = ("vehicle00", "edge"),
    topics: Sequence[str] = (CLOUD[0],),
    targets: Sequence[str] | None = None,
    broker: str = "edge",
    type: int = 1,
) -> Item:
    return {
        "id": id,
        "broker_node_id": broker,
        "requester_ids": list(who),
        "source_node_id": ends[0],
        "source_topics": list(topics),
        "target_node_id": ends[1],
        "target_topics": list(topics if targets is None else targets),
        "type": type,
    }


def goal(
    apps: Iterable[Item] = (),
    connections: Iterable[Item] = (),
    *,
    id: str = "request",
    shutdown: bool = False,
) -> Goal:
    return {"id": id, "apps": list(apps), "connections": list(connections), "shutdown": shutdown}


def perception(**changed: Any) -> Goal:
    return goal([application()], [connection()]) | changed


def numbered(number: int, *, shutdown: bool = False, vehicle: int | None = None) -> Goal:
    """Return demand ``number``.

    Its requesters are ``user<number>``, who has no other demand, and ``station00``. Demands 0, 5,
    10, … have the same application. Without ``vehicle``, demands 0, 4, 8, … have the same
    connection.
    """
    name = f"vehicle{(number if vehicle is None else vehicle) % 4:02}"
    who = [f"user{number}", "station00"]
    ego = (f"/vehicles/{name}/ego_data", name)
    app = application(f"edge/fusion-{number % 5}", who=who, ego=[ego], clouds=[STATION_CLOUD])
    link = connection(f"{name}/edge", who=who, ends=(name, "edge"), topics=[ego[0]])
    return goal([app], [link], id=f"demand-{number}", shutdown=shutdown)


def leave(number: int) -> Goal:
    return numbered(number, shutdown=True)


def impossible() -> Goal:
    made = numbered(0)
    made["apps"][0]["header"]["node_id"] = "nowhere"
    return made


def link(number: int, **more: Any) -> Goal:
    item = connection(f"c{number}", who=[f"r{number}"], topics=[f"/t{number}"], broker="")
    return goal([], [item | more], id=f"request{number}")


def put(
    demand: str,
    *who: str,
    id: str = "",
    topic: Topic = ("/ego", "vehicle00"),
    node: str = "edge",
    **more: Any,
) -> Goal:
    inputs = {"ego_data": [{"topic": topic[0], "source": topic[1]}]}
    item = {"id": id or f"edge/{demand[:100]}", "type": "object-detection-fusion", "node": node}
    item |= {"inputs": inputs} | ({"connect": more.pop("connect")} if "connect" in more else {})
    made = {"kind": "Demand", "demand": demand, "requesters": list(who or ["vehicle00"])}
    return made | {"applications": [item]} | more


def experiment(step: int) -> Goal:
    made: Goal = plain_yaml.load(EXPERIMENT[step - 1].read_text())
    return made
