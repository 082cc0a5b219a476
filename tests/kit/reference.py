"""A stand-in for the reference: it turns goals into custom resources and operators' files.

The stand-in is our own code, with the reference's names and formats. It was compared with the real
operators, which ran on a stand-in for their cluster's API: after random goals, all files were
equal. It also repeats an oddity of the operators: see :meth:`Reference._note`.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import yaml

Item = dict[str, Any]

HOSTS = {"cloud": ("service-mqtt-broker-cloud", 1883), "edge": ("service-mqtt-broker-edge", 1993)}
OPERATORS = {
    "MqttConnection": "mqtt",
    "ObjectDetection": "object_detection",
    "ObjectFusion": "object_fusion",
}


def slug(id: str) -> str:
    return id.replace("_", "-").replace("/", "-")


class Reference:
    """A running application manager with its operators."""

    def __init__(self) -> None:
        self.resources: dict[str, Item] = {}
        self.books: dict[str, Item] = {kind: {} for kind in OPERATORS}
        self._versions: dict[str, Item] = {kind: {} for kind in OPERATORS}
        self._saved: dict[str, Item] = {kind: {} for kind in OPERATORS}
        self._version = 1000

    def send(self, goal: Item) -> None:
        """Carry out a goal of DeploymentRequest."""
        shutdown = goal.get("shutdown", False)
        for app in goal.get("apps", ()):
            for name, kind, spec in _of_application(app, shutdown):
                self._apply(name, kind, spec)
        for connection in goal.get("connections", ()):
            self._apply(*_of_connection(connection, shutdown))

    def _apply(self, name: str, kind: str, spec: Item) -> None:
        """Create or patch a resource; if that changes it, its operator records the request."""
        known = self.resources.get(name)
        merged = _merged(known["spec"], spec) if known else copy.deepcopy(spec)
        if known and merged == known["spec"]:
            return
        self._version += 7
        self.resources[name] = {
            "apiVersion": "ika.rwth-aachen.de/v1",
            "kind": kind,
            "metadata": {
                "name": name,
                "labels": {"name": name, "tag": "application-manager"},
                "namespace": "default",
                "resourceVersion": str(self._version),
            },
            "spec": merged,
        }
        self._note(name, kind, copy.deepcopy(merged["operator"]), created=known is None)

    def _note(self, name: str, kind: str, request: Item, *, created: bool) -> None:
        """Write an operator's versioning file and its bookkeeping file.

        The operators have an oddity: for a new connection or detection, the bookkeeping and the
        first request are one list of requesters in memory. So the versioning file also shows later
        requesters under the first request.
        """
        self._versions[kind].setdefault(name, {})[str(self._version)] = request
        self._saved[kind] = copy.deepcopy(self._versions[kind])
        book = self.books[kind]
        if kind == "ObjectFusion":
            if created:
                book[name] = {"topicsEgoData": {}, "topicsObjectlist": {}}
            for part, topics in book[name].items():
                for topic in request[part]:
                    _count(topics.setdefault(topic, []), request)
                    if not topics[topic]:
                        del topics[topic]
            left = any(book[name].values())
        else:
            if created:
                book[name] = request["requester"]
            else:
                _count(book[name], request)
            left = bool(book[name])
        if not left:
            del self.resources[name], book[name]

    def texts(self) -> dict[str, str]:
        """Return texts by file name: the operators' files, and one file of custom resources."""
        files = {}
        for kind, operator in OPERATORS.items():
            files[f"{operator}_bookkeeping.yml"] = yaml.dump(self.books[kind])
            files[f"{operator}_versioning.yml"] = yaml.dump(self._saved[kind])
        items = [self.resources[name] for name in sorted(self.resources)]
        listed = {"apiVersion": "v1", "kind": "List", "items": items}
        return files | {"resources.yaml": yaml.safe_dump(listed)}

    def write(self, folder: Path) -> list[Path]:
        """Write all files into a folder; return their paths."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in self.texts().items():
            folder.joinpath(name).write_text(text)
        return [folder / name for name in self.texts()]


def _count(requesters: list[str], request: Item) -> None:
    if request["shutdown"]:
        for who in request["requester"]:
            requesters.remove(who)
    else:
        requesters.extend(request["requester"])


def _merged(known: Item, patch: Item) -> Item:
    both = {
        key: _merged(known[key], patch[key])
        for key in known.keys() & patch.keys()
        if isinstance(known[key], dict) and isinstance(patch[key], dict)
    }
    return copy.deepcopy(known | patch | both)


def _operator(item: Item, shutdown: bool, **more: Any) -> Item:
    return {"namespace": "default", "requester": item["requester_ids"], "shutdown": shutdown} | more


def _launch(package: str, file: str, **arguments: str) -> list[str]:
    words = [f"{name}:={value}" for name, value in arguments.items()]
    return [
        "/bin/bash",
        "-c",
        " ".join(["source install/setup.bash && ros2 launch", package, file, *words]),
    ]


def _of_application(app: Item, shutdown: bool) -> list[tuple[str, str, Item]]:
    id, node = app["header"]["id"], app["header"]["node_id"]
    body, found = app["object_detection_fusion_app"], {}
    for cloud in body.get("pointcloud_topics", ()):
        source = cloud["source_node_id"]
        name = f"od-{slug(f'{node}_{source}')}"
        found[source] = (
            name,
            "ObjectDetection",
            {
                "operator": _operator(body, shutdown),
                "name": name,
                "commandOverride": _launch(
                    "point_cloud_object_detection",
                    "point_cloud_object_detection.launch.py",
                    node_name=f"pcod_{source}",
                    point_cloud_topic=cloud["topic_name"],
                    object_list_topic=f"/{source}_local_objectlist",
                ),
                "labelTag": "application-manager",
                "terminationGracePeriodSeconds": 1,
                "nodeSelector": {"node_id": node},
                "image": {},
                "configDetection": {"ros_node_name": f"pcod_{source}"},
            },
        )
    name = f"of-{slug(id)}"
    inputs = {
        "topicsEgoData": [topic["topic_name"] for topic in body.get("ego_data_topics", ())],
        "topicsObjectlist": [f"/{source}_local_objectlist" for source in found],
    }
    fusion = {
        "operator": _operator(body, shutdown, **inputs),
        "fusion": {"name": name, "nodeSelector": {"node_id": node}},
        "watcher": {"name": f"{name}-watcher", "nodeSelector": {"node_id": node}},
    }
    return [*found.values(), (name, "ObjectFusion", fusion)]


def _of_connection(connection: Item, shutdown: bool) -> tuple[str, str, Item]:
    sources, targets = connection["source_topics"], connection["target_topics"]
    wanted = (connection.get("broker_node_id"), connection["target_node_id"])
    host, port = next(
        HOSTS[node] for node in (*wanted, connection["source_node_id"]) if node in HOSTS
    )
    ros2mqtt = {"ros_topics": sources} | {name: {"mqtt_topic": f"mqtt{name}"} for name in sources}
    mqtt2ros = {"mqtt_topics": [f"mqtt{name}" for name in targets]}
    mqtt2ros |= {f"mqtt{name}": {"ros_topic": name} for name in targets}
    spec = {
        "operator": _operator(connection, shutdown),
        "configSource": {
            "nodeSelector": {"node_id": connection["source_node_id"]},
            "configMQTT": {"bridge": {"ros2mqtt": ros2mqtt}},
        }
        if sources
        else {},
        "configTarget": {
            "nodeSelector": {"node_id": connection["target_node_id"]},
            "configMQTT": {"bridge": {"mqtt2ros": mqtt2ros}},
        }
        if targets
        else {},
        "configCommon": {"labelTag": "application-manager", "broker": {"host": host, "port": port}},
    }
    return f"mqtt-connection-{slug(connection['id'])}", "MqttConnection", spec
