"""Goals of ``DeploymentRequest`` that book again what requesters still hold in the reference."""

from __future__ import annotations

from collections import Counter
from typing import Any

from demandops.errors import Fault, InvalidInput, fault
from demandops.migration.reference_files import (
    CONNECTION,
    DETECTION,
    FUSION,
    ObjectDetection,
    ReferenceFiles,
)
from demandops.migration.reference_map import ReferenceMap, is_object_list
from demandops.migration.remaining_joins import Join, remaining, replayed

_MQTT, _OBJECT_DETECTION_FUSION = 1, 1  # the numbers of these types in ROS messages


def remaining_joins(files: ReferenceFiles) -> tuple[dict[str, list[Join]], list[str]]:
    """Return a map from resource to the joins that no shutdown has undone yet, and warnings.

    Resources that nobody holds are left out. Detections are left out too, because a goal for a
    fusion brings the detections that the fusion needs. If the files have only the spec of a
    resource, the joins are those of its last request, and a warning says so.

    Raises:
        InvalidInput: if a connection has several requests, but no bookkeeping.
    """
    joins, warnings, faults = dict[str, list[Join]](), list[str](), list[Fault]()
    for name in files.names():
        spec, requests = files.specs.get(name), files.versions.get(name, {})
        if name.startswith(DETECTION):
            continue
        book = files.books.get(name)
        if book is None and any(name.startswith(prefix) for prefix in files.booked) and not spec:
            continue  # the resource is deleted, and the operator keeps only its requests
        if book is None and requests:
            if name.startswith(CONNECTION) and len(requests) > 1:
                faults.append(_rewritten(name))
                continue
            book = replayed(requests)
        elif book is None and spec:
            book = Counter() if spec.operator.shutdown else spec.operator.holds()
            warnings.append(_last_request_only(name, spec.operator.shutdown))
        joins[name] = remaining(book or Counter(), requests)
    if faults:
        raise InvalidInput(faults)
    warnings += _unused(files, joins)
    return {name: found for name, found in joins.items() if found}, warnings


def _rewritten(name: str) -> Fault:
    message = (
        "has requests, but no bookkeeping. The requests alone do not tell who holds the "
        "connection, because the reference's operator adds each later requester to the first "
        "request. Give an mqtt_bookkeeping.yml that has the connection. If this file is lost, "
        "write one that lists each requester as often as it holds the connection, such as "
        f"'{name}: [vehicle00]'"
    )
    return fault(name, message)


def _last_request_only(name: str, shutdown: bool) -> str:
    if shutdown:
        return (
            f"{name} is not imported, because its last request was a shutdown and the bookkeeping "
            "files do not say who still holds it"
        )
    return (
        f"{name}: the bookkeeping files do not say who holds it, so only the requesters that its "
        "last request lists are imported, each with one hold"
    )


def _unused(files: ReferenceFiles, joins: dict[str, list[Join]]) -> list[str]:
    """Return a warning for each detection whose object list no application reads."""
    topics = {topic for found in joins.values() for join in found for topic in join.topics}
    return [
        f"{name} is not imported, because no application reads its object list"
        for name, spec in files.specs_of(ObjectDetection).items()
        if f"/{spec.source}_local_objectlist" not in topics
    ]


def goals(joins: dict[str, list[Join]], mapped: ReferenceMap, file: str) -> list[dict[str, Any]]:
    """Return goals, oldest first: one for each set of requesters that hold something together.

    If requesters hold a resource twice, they get a second goal with another id, because the ledger
    counts a repeated goal once. ``file`` is the map's file, which errors name.

    Raises:
        InvalidInput: if the map in ``file`` has no entry for a resource or a topic.
    """
    found: dict[tuple[int, frozenset[str]], dict[str, Any]] = {}
    faults = list[Fault]()
    ordered = sorted(
        ((join.version, name, join) for name, theirs in joins.items() for join in theirs),
        key=lambda one: one[0],
    )
    times = Counter[tuple[str, frozenset[str]]]()
    for _, name, join in ordered:
        requesters = frozenset(join.requesters)
        times[name, requesters] += 1
        time = times[name, requesters]
        goal = found.setdefault(
            (time, requesters),
            {"id": f"{mapped.request}#{time}" if time > 1 else mapped.request}
            | {"apps": [], "connections": []},
        )
        try:
            if name.startswith(FUSION):
                goal["apps"].append(_application(name, join, mapped))
            else:
                goal["connections"].append(_connection(name, join, mapped))
        except InvalidInput as error:
            faults += (each.within(file) for each in error.faults)
    if faults:
        raise InvalidInput(dict.fromkeys(faults))
    return list(found.values())


def _application(name: str, join: Join, mapped: ReferenceMap) -> dict[str, Any]:
    app = mapped.applications.get(name)
    if app is None:
        raise InvalidInput.at(f"applications.{name}", _MISSING)
    missing = [
        one for one in join.topics if one not in app.ego_data and one not in app.point_clouds
    ]
    if missing:
        where = f"applications.{name}"
        raise InvalidInput(
            fault(
                f"{where}.{'pointClouds' if is_object_list(topic) else 'egoData'}.{topic}", _MISSING
            )
            for topic in missing
        )
    clouds = [app.point_clouds[topic] for topic in join.topics if topic in app.point_clouds]
    ego_data = {topic: app.ego_data[topic] for topic in join.topics if topic in app.ego_data}
    return {
        "header": {"id": app.id, "node_id": app.node},
        "type": _OBJECT_DETECTION_FUSION,
        "object_detection_fusion_app": {
            "requester_ids": list(join.requesters),
            "ego_data_topics": [
                {"topic_name": topic, "source_node_id": source}
                for topic, source in ego_data.items()
            ],
            "pointcloud_topics": [
                {"topic_name": cloud.topic, "source_node_id": cloud.source} for cloud in clouds
            ],
        },
    }


def _connection(name: str, join: Join, mapped: ReferenceMap) -> dict[str, Any]:
    connection = mapped.connections.get(name)
    if connection is None:
        raise InvalidInput.at(f"connections.{name}", _MISSING)
    return {
        "id": connection.id,
        "broker_node_id": connection.broker,
        "requester_ids": list(join.requesters),
        "source_node_id": connection.source,
        "source_topics": [topic.source for topic in connection.topics],
        "target_node_id": connection.target,
        "target_topics": [topic.target for topic in connection.topics],
        "type": _MQTT,
    }


_MISSING = "is missing; add it, or remove the map so that import proposes a new one"
