"""Goals of the reference's action, as plain data, and a state repo in memory to send them to.

Shared by the tests of demand, catalog, render and of the command line, which find this folder
through their ``conftest.py``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from functools import lru_cache
from typing import Any

import pytest
import yaml
from demandops.config.config import CONFIG_ROOTS, Config
from demandops.config.load import load
from demandops.decision import Decision, State, decide, rendered_files
from demandops.errors import Refused
from demandops.ledger.ledger import Ledger
from demandops.plan.views.bookkeeping import as_data, bookkeeping
from demandops.staterepo import new_repo

Goal = dict[str, Any]
Item = dict[str, Any]
FAST: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

Topic = tuple[str, str]
"""Topic name and the node that publishes it."""

NOW = datetime(2026, 1, 31, 12, 0, tzinfo=timezone.utc)

APP = "edge/object_detection_fusion"
CLOUD: Topic = ("/vehicles/vehicle00/drivers/lidar/pointcloud", "vehicle00")
"""The usual point cloud of vehicle00 in the skeleton's inventory."""
EGO: Topic = ("/vehicles/vehicle00/ego_data", "vehicle00")
STATION_CLOUD: Topic = ("/stations/station00/pointcloud", "station00")

BODY = "apps[0].object_detection_fusion_app"
ROS_NAMES = (
    "is not a topic name that ROS 2 allows; use letters, digits and '_' between single '/', no "
    "part starting with a digit"
)


@lru_cache(maxsize=1)
def skeleton() -> Mapping[str, str]:
    """Return every file of a state repo as ``demandops init`` lays it down."""
    return new_repo.files()


def configuration(changed: Mapping[str, str | None] | None = None) -> dict[str, str]:
    """Return the skeleton's files that people own, some of them changed or (``None``) left out."""
    files: dict[str, str | None] = {
        path: text for path, text in skeleton().items() if path.split("/")[0] in CONFIG_ROOTS
    }
    files |= changed or {}
    return {path: text for path, text in files.items() if text is not None}


def edited(path: str, old: str, new: str) -> dict[str, str]:
    """Return one file of the skeleton with the first ``old`` in it made ``new``."""
    text = skeleton()[path]
    assert old in text, f"{path} holds no {old!r}"
    return {path: text.replace(old, new, 1)}


def brokers(*nodes: str) -> dict[str, str]:
    """Return an ``inventory/brokers.yaml`` with a broker on each of ``nodes``."""
    entries = [{"node": node, "host": f"broker-{node}"} for node in nodes]
    head = {"apiVersion": "demandops/v1", "kind": "Brokers"}
    return {"inventory/brokers.yaml": yaml.safe_dump(head | {"brokers": entries})}


def application(
    id: str = APP,
    *,
    node: str = "edge",
    who: Sequence[str] = ("vehicle00",),
    ego: Iterable[Topic] = (),
    clouds: Iterable[Topic] = (CLOUD,),
    type: int = 1,
) -> Item:
    """Return one application of a goal."""
    return {
        "header": {"id": id, "node_id": node},
        "type": type,
        "object_detection_fusion_app": {
            "requester_ids": list(who),
            "ego_data_topics": [_topic(topic) for topic in ego],
            "pointcloud_topics": [_topic(topic) for topic in clouds],
        },
    }


def _topic(topic: Topic) -> dict[str, str]:
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
    """Return one connection of a goal; source and target topics are the same unless told."""
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
    """Return a goal."""
    return {
        "id": id,
        "apps": list(apps),
        "connections": list(connections),
        "shutdown": shutdown,
    }


def perception(**changed: Any) -> Goal:
    """Return the plain goal that always works: perception on the edge, and what feeds it."""
    return goal([application()], [connection()]) | changed


def _state(changed: Mapping[str, str | None]) -> State:
    return State.of(load(configuration(changed)), Ledger())


@lru_cache(maxsize=1)
def _unchanged() -> State:
    return _state({})


class Books:
    """A state repo in memory: what a demand decides is there for the next one."""

    def __init__(self, changed: Mapping[str, str | None] | None = None) -> None:
        """Start with the skeleton, some of its files changed, and nothing booked."""
        self.state = _unchanged() if changed is None else _state(changed)
        self._standing = dict(skeleton())
        if changed is not None:
            self._standing = {**configuration(changed), **rendered_files(self.state)}
        self.files = dict(self._standing)

    def copy(self) -> Books:
        """Return another one that starts where this one is."""
        twin = Books()
        twin.state, twin._standing, twin.files = self.state, self._standing, dict(self.files)
        return twin

    @property
    def config(self) -> Config:
        """What can be run."""
        return self.state.config

    def send(self, goal: object) -> Decision:
        """Decide a goal and keep what comes of it; raises what ``decide`` raises."""
        decision = decide(self.state, goal, NOW, self.files.get)
        self.state = decision.state
        for path, text in decision.files.items():
            if text is None:
                del self.files[path]
            else:
                self.files[path] = text
        return decision

    def faults(self, goal: object) -> list[str]:
        """Return the faults of a goal that must be refused, each as ``field: message``."""
        before = dict(self.files), self.state
        with pytest.raises(Refused) as refused:
            self.send(goal)
        assert (self.files, self.state) == before, "a refused demand changed something"
        return [f"{found.field}: {found.message}" for found in refused.value.faults]

    def books(self) -> dict[str, Any]:
        """Return the bookkeeping as plain data, without its commit."""
        data = as_data(bookkeeping(self.state.ledger, self.state.config), "")
        return {"services": data["services"], "connections": data["connections"]}

    def rendered(self) -> dict[str, str]:
        """Return what stands below ``clusters/`` because it is demanded."""
        return {
            path: text
            for path, text in self.files.items()
            if path.startswith("clusters/") and path not in self._standing
        }

    def objects(self, kind: str) -> dict[str, dict[str, Any]]:
        """Return the rendered objects of a kind by name."""
        documents = [
            document
            for text in self.rendered().values()
            for document in yaml.load_all(text, Loader=FAST)
        ]
        found = [document for document in documents if document["kind"] == kind]
        named = {document["metadata"]["name"]: document for document in found}
        assert len(named) == len(found), "two objects have one name"
        return named
