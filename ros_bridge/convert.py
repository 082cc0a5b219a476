"""Messages as plain data. Knows no rclpy: any message of rosidl's Python will do."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from generator.settings import API_VERSION


def as_data(message: Any) -> Any:  # noqa: ANN401 - messages are generated classes
    """Return a message as mappings, lists and plain values, as its YAML form would parse.

    ``DeploymentRequest.Goal`` becomes what :func:`generator.demand.wire.parse` takes, so that a
    goal over ROS 2 and the same goal in a file are one thing.
    """
    fields = getattr(message, "get_fields_and_field_types", None)
    if fields is not None:
        return {name: as_data(getattr(message, name)) for name in fields()}
    if isinstance(message, str | bool | int | float):
        return message
    return [as_data(item) for item in message]


_OPERATIONS = ("put", "release", "renew")
_TYPES = ("auto", "mqtt", "zenoh", "ros", "none")
_ANSWERS = ("pushed", "reconciled", "healthy")


def demand_data(goal: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return a ``Demand.Goal`` as what :func:`generator.demand.own.parse` takes.

    A number that the message does not define is passed on as text, to be refused with its field.
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
            for route in connection.topics
        ],
    }


def from_data(message: Any, data: dict[str, Any]) -> Any:  # noqa: ANN401
    """Fill a message from plain data and return it; absent fields keep ROS's defaults.

    Raises:
        AttributeError: for a field that the message has not.
        AssertionError, TypeError: for a value of another type.
    """
    types = message.get_fields_and_field_types()
    for name, value in data.items():
        if name not in types:
            raise AttributeError(f"{type(message).__name__} has no field '{name}'")
        setattr(message, name, _valued(getattr(message, name), types[name], value))
    return message


def _valued(default: Any, type_name: str, value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return from_data(default, value)
    if isinstance(value, list) and "/" in type_name:
        return [from_data(_new(type_name), item) for item in value]
    return value


def _new(type_name: str) -> Any:  # noqa: ANN401
    """Return a message of a sequence's type: ``sequence<pkg/Name>``."""
    package, name = type_name.removeprefix("sequence<").split(">")[0].split(",")[0].split("/")
    return getattr(import_module(f"{package}.msg"), name)()
