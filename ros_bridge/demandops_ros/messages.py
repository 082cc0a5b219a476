"""Converts ROS messages to plain data and back; needs the messages only, not rclpy."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from builtin_interfaces.msg import Duration
from demandops.config.policy import seconds_of
from demandops.connections.route import RouteOptions
from demandops.errors import suggestion
from demandops.settings import API_VERSION
from demandops_interfaces import msg as messages
from demandops_interfaces.action import Demand as DemandMessage


def message_to_data(message: Any) -> Any:  # noqa: ANN401 - messages are generated classes
    """Return a message as mappings, lists and plain values, as its YAML form parses.

    A ``DeploymentRequest.Goal`` becomes what
    :func:`demandops.demand.deployment_request_goal.parse` takes, so that a goal over ROS 2 equals
    the same goal in a file.
    """
    fields = getattr(message, "get_fields_and_field_types", None)
    if fields is not None:
        return {name: message_to_data(getattr(message, name)) for name in fields()}
    if isinstance(message, str | bool | int | float):
        return message
    return [message_to_data(item) for item in message]


_OPERATIONS = ("put", "release", "renew")
_TYPES = ("auto", "mqtt", "zenoh", "ros", "none")
_OPTIONS = tuple(RouteOptions.model_fields)
_ANSWERS = ("pushed", "reconciled", "healthy")


def demand_goal_to_data(goal: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return a ``Demand.Goal`` as plain data for :func:`demandops.demand.demand_goal.parse`.

    A number that the message does not define becomes text, which the parser refuses by field.
    """
    data = {
        "apiVersion": API_VERSION,
        "kind": "Demand",
        "operation": _word(_OPERATIONS, goal.operation),
        "demand": goal.demand_id,
        "request": goal.request_id,
        "requesters": list(goal.requester_ids),
        "applications": [_application(app) for app in goal.applications],
        "connections": [_connection(connection) for connection in goal.connections],
        "answer": _word(_ANSWERS, goal.answer),
    }
    if goal.lease.sec or goal.lease.nanosec:  # a part of a second counts as a whole one
        data["lease"] = goal.lease.sec + bool(goal.lease.nanosec)
    return data


def demand_goal_from_data(data: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return the ``Demand.Goal`` for a document of the kind ``Demand``.

    Raises:
        ValueError: for an unknown field or word.
        TypeError, AssertionError: for a value of the wrong type.
    """
    goal = DemandMessage.Goal()
    known = {"apiVersion", "kind", "lease", "operation", "answer", "applications", "connections"}
    names = {"demand": "demand_id", "request": "request_id", "requesters": "requester_ids"}
    _reject_unknown(data, {*known, *names}, "a demand")
    for name, field in names.items():
        if name in data:
            setattr(goal, field, data[name])
    goal.operation = _number(_OPERATIONS, data.get("operation", "put"), "operation")
    goal.answer = _number(_ANSWERS, data.get("answer", "pushed"), "answer")
    lease = data.get("lease") or 0
    seconds = seconds_of(lease) if isinstance(lease, str) else lease
    goal.lease = Duration(sec=int(seconds), nanosec=int(seconds % 1 * 1e9))
    goal.applications = [_application_message(app) for app in data.get("applications", ())]
    goal.connections = [_connection_message(item) for item in data.get("connections", ())]
    return goal


def _application_message(data: Mapping[str, Any]) -> Any:  # noqa: ANN401
    known = {"inputs", "parameters", "parameters_json", "connect"}
    names = {"id": "id", "type": "type", "node": "node_id", "version": "version"}
    _reject_unknown(data, {*known, *names}, "an application")
    values = {name: json.dumps(value) for name, value in data.get("parameters", {}).items()}
    values |= data.get("parameters_json", {})
    return messages.Application(
        **{field: data[name] for name, field in names.items() if name in data},
        inputs=[
            messages.Input(
                role=role,
                topic_name=topic.get("topic", ""),
                source_node_id=topic.get("source", ""),
                type=topic.get("type", ""),
            )
            for role, topics in data.get("inputs", {}).items()
            for topic in topics
        ],
        parameters=[messages.Parameter(name=name, value_json=v) for name, v in values.items()],
        connect=_number(_TYPES, data.get("connect", "auto"), "connect"),
    )


def _connection_message(data: Mapping[str, Any]) -> Any:  # noqa: ANN401
    names = {
        "id": "id",
        "source": "source_node_id",
        "target": "target_node_id",
        "broker": "broker_node_id",
    }
    _reject_unknown(data, {"type", "topics", *names}, "a connection")
    return messages.Connection(
        **{field: data[name] for name, field in names.items() if name in data},
        type=_number(_TYPES[:-1], data.get("type", "auto"), "type"),
        topics=[_route_message(route) for route in data.get("topics", ())],
    )


def _route_message(data: Mapping[str, Any]) -> Any:  # noqa: ANN401
    _reject_unknown(data, {"source", "target", *_OPTIONS}, "a topic of a connection")
    options = {name: data[name] for name in _OPTIONS if name in data}
    if "rate" in options:
        options["rate"] = float(options["rate"])
    names = {"source_topic": data.get("source", ""), "target_topic": data.get("target", "")}
    return messages.Route(**names, **options)


def _reject_unknown(data: Mapping[str, Any], known: set[str], what: str) -> None:
    for name in data:
        if name not in known:
            raise ValueError(f"'{name}' is not a field of {what}{suggestion(name, known)}")


def _number(words: tuple[str, ...], word: str, field: str) -> int:
    if word not in words:
        raise ValueError(f"{field}: '{word}' is not one of {', '.join(words)}")
    return words.index(word)


def _word(words: tuple[str, ...], number: int) -> str:
    return words[number] if number < len(words) else str(number)


def _application(app: Any) -> dict[str, Any]:  # noqa: ANN401
    inputs: dict[str, list[dict[str, str]]] = {}
    for item in app.inputs:
        topic = {"topic": item.topic_name, "source": item.source_node_id, "type": item.type}
        inputs.setdefault(item.role, []).append(topic)
    return {
        "id": app.id,
        "type": app.type,
        "node": app.node_id,
        "inputs": inputs,
        "parameters_json": {parameter.name: parameter.value_json for parameter in app.parameters},
        "version": app.version,
        "connect": _word(_TYPES, app.connect),
    }


def _connection(connection: Any) -> dict[str, Any]:  # noqa: ANN401
    return {
        "id": connection.id,
        "type": _word(_TYPES[:-1], connection.type),
        "source": connection.source_node_id,
        "target": connection.target_node_id,
        "broker": connection.broker_node_id,
        "topics": [
            {"source": route.source_topic, "target": route.target_topic}
            | {name: getattr(route, name) for name in _OPTIONS}
            for route in connection.topics
        ],
    }


def fill_message(message: Any, data: dict[str, Any]) -> Any:  # noqa: ANN401
    """Fill a message from plain data and return it; missing fields keep ROS's defaults.

    Raises:
        AttributeError: for a field that the message does not have.
        AssertionError, TypeError: for a value of the wrong type.
    """
    types = message.get_fields_and_field_types()
    for name, value in data.items():
        if name not in types:
            raise AttributeError(f"{type(message).__name__} has no field '{name}'")
        setattr(message, name, _converted(getattr(message, name), types[name], value))
    return message


def _converted(default: Any, type_name: str, value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return fill_message(default, value)
    if isinstance(value, list) and "/" in type_name:
        return [fill_message(_new(type_name), item) for item in value]
    return value


def _new(type_name: str) -> Any:  # noqa: ANN401
    """Return a new message of the type in ``sequence<pkg/Name>``."""
    package, name = type_name.removeprefix("sequence<").split(">")[0].split(",")[0].split("/")
    return getattr(import_module(f"{package}.msg"), name)()
