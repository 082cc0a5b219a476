"""Converts ROS messages to plain data and back; needs only message packages, not rclpy."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from demandops.base.errors import suggestion
from demandops.base.settings import API_VERSION
from demandops.cluster.health import Level
from demandops.connections.connection import ROUTE_OPTIONS
from demandops.model.config.base_model import seconds_of
from demandops_interfaces.action import Demand as DemandMessage


def message_to_data(message: Any) -> Any:  # noqa: ANN401 - messages are generated classes
    # in the form that its YAML text has, so that a goal over ROS 2 equals the same goal in a file
    if (fields := getattr(message, "get_fields_and_field_types", None)) is not None:
        return {name: message_to_data(getattr(message, name)) for name in fields()}
    if isinstance(message, str | bool | int | float):
        return message
    return [message_to_data(item) for item in message]


_OPERATIONS = ("put", "release", "renew")
_TYPES = ("auto", "mqtt", "zenoh", "ros", "none")
ANSWER_LEVELS: tuple[Level, ...] = ("pushed", "reconciled", "healthy")

# each mapping: the name of a field in a document → the name of the field in the message
_DEMAND = {
    "demand": "demand_id",
    "request": "request_id",
    "requesters": "requester_ids",
    "priority": "priority",
}
_APPLICATION = {"id": "id", "type": "type", "node": "node_id", "version": "version"}
_PLACE = {name: name for name in ("role", "labels", "capabilities", "properties")}
_DELIVERY = {"output": "output", "node": "node_id", "topic": "topic_name"}
_POSITION = {"node": "node_id", "x": "x", "y": "y"}
_INPUT = {"topic": "topic_name", "source": "source_node_id", "type": "type"}
_INPUT |= {"application": "application_id", "output": "output"}
_CONNECTION = {
    "id": "id",
    "source": "source_node_id",
    "target": "target_node_id",
    "broker": "broker_node_id",
}
_ROUTE = {"source": "source_topic", "target": "target_topic"}
_ROUTE |= {name: name for name in ROUTE_OPTIONS}


def demand_goal_to_data(goal: Any) -> dict[str, Any]:  # noqa: ANN401
    data = {
        "apiVersion": API_VERSION,
        "kind": "Demand",
        "operation": _word(_OPERATIONS, goal.operation),
        **_data(goal, _DEMAND),
        "applications": [_application(app) for app in goal.applications],
        "connections": [
            {
                **_data(connection, _CONNECTION),
                "type": _word(_TYPES[:-1], connection.type),
                "topics": [_data(route, _ROUTE) for route in connection.topics],
            }
            for connection in goal.connections
        ],
        "positions": [_data(position, _POSITION) for position in goal.positions],
        "answer": _word(ANSWER_LEVELS, goal.answer),
    }
    if goal.lease.sec or goal.lease.nanosec:  # rounded up, so that no lease ends too early
        data["lease"] = goal.lease.sec + bool(goal.lease.nanosec)
    return data


def demand_goal_from_data(data: Mapping[str, Any]) -> Any:  # noqa: ANN401
    # An unknown field or word, or a lease that is no duration, raises ValueError. A value that the
    # message cannot carry raises TypeError, AssertionError, AttributeError or OverflowError.
    more = {"apiVersion", "kind", "lease", "operation", "answer"}
    more |= {"applications", "connections", "positions"}
    lease = data.get("lease") or 0
    seconds = seconds_of(lease) if isinstance(lease, str) else lease
    fields = {
        **_fields(data, _DEMAND, more, "a demand"),
        "operation": _number(_OPERATIONS, data.get("operation", "put"), "operation"),
        "answer": _number(ANSWER_LEVELS, data.get("answer", "pushed"), "answer"),
        "lease": {"sec": int(seconds), "nanosec": int(seconds % 1 * 1e9)},
        "applications": [_application_fields(app) for app in data.get("applications", ())],
        "connections": [
            {
                **_fields(item, _CONNECTION, {"type", "topics"}, "a connection"),
                "type": _number(_TYPES[:-1], item.get("type", "auto"), "type"),
                "topics": _items(item, "topics", _ROUTE, "a topic of a connection"),
            }
            for item in data.get("connections", ())
        ],
        "positions": _items(data, "positions", _POSITION, "a position"),
    }
    return fill_message(DemandMessage.Goal(), fields)


def _application(app: Any) -> dict[str, Any]:  # noqa: ANN401
    inputs: dict[str, list[dict[str, str]]] = {}
    for item in app.inputs:
        inputs.setdefault(item.role, []).append(_data(item, _INPUT))
    connect = _word(_TYPES, app.connect)
    return {
        **_data(app, _APPLICATION),
        "services": {
            service: node for service, _, node in (text.partition("=") for text in app.services)
        },
        "inputs": inputs,
        "parameters_json": {parameter.name: parameter.value_json for parameter in app.parameters},
        "connect": {"type": connect, "broker": app.connect_broker}
        if app.connect_broker
        else connect,
        "place": _data(app, _PLACE),
        "deliver": [_data(delivery, _DELIVERY) for delivery in app.deliver],
    }


def _application_fields(data: Mapping[str, Any]) -> dict[str, Any]:
    others = {"inputs", "parameters", "parameters_json", "connect", "place", "deliver", "services"}
    values = {name: json.dumps(value) for name, value in data.get("parameters", {}).items()}
    values |= data.get("parameters_json", {})
    connect = data.get("connect", "auto")
    connect = {"type": connect} if isinstance(connect, str) else connect
    return {
        **_fields(data, _APPLICATION, others, "an application"),
        **_fields(data.get("place", {}), _PLACE, set(), "a place"),
        **_fields(connect, {"broker": "connect_broker"}, {"type"}, "connect"),
        "services": [f"{name}={node}" for name, node in data.get("services", {}).items()],
        "deliver": _items(data, "deliver", _DELIVERY, "a delivery"),
        "inputs": [
            {"role": role, **_fields(topic, _INPUT, set(), "an input")}
            for role, topics in data.get("inputs", {}).items()
            for topic in topics
        ],
        "parameters": [{"name": name, "value_json": text} for name, text in values.items()],
        "connect": _number(_TYPES, connect.get("type", "auto"), "connect"),
    }


def _data(message: Any, names: Mapping[str, str]) -> dict[str, Any]:  # noqa: ANN401
    return {name: getattr(message, field) for name, field in names.items()}


def _fields(
    data: Mapping[str, Any], names: Mapping[str, str], others: set[str], what: str
) -> dict[str, Any]:
    allowed = {*others, *names}
    for name in data:
        if name not in allowed:
            raise ValueError(f"'{name}' is not a field of {what}{suggestion(name, allowed)}")
    return {field: data[name] for name, field in names.items() if name in data}


def _items(
    data: Mapping[str, Any], key: str, names: Mapping[str, str], what: str
) -> list[dict[str, Any]]:
    return [_fields(item, names, set(), what) for item in data.get(key, ())]


def _number(words: tuple[str, ...], word: str, field: str) -> int:
    if word not in words:
        raise ValueError(f"{field}: '{word}' is not one of {', '.join(words)}")
    return words.index(word)


def _word(words: tuple[str, ...], number: int) -> str:
    # of a number without a word, the parser refuses the text, and so names the field
    return words[number] if number < len(words) else str(number)


def fill_message(message: Any, data: dict[str, Any]) -> Any:  # noqa: ANN401
    # Missing fields keep ROS's defaults. A field or value that the message cannot carry raises
    # AttributeError, AssertionError or TypeError.
    if hasattr(message, "_check_fields"):
        # Else a message may not check the values that are assigned to it, and one of a wrong type
        # would end the process when the message is sent.
        message._check_fields = True
    types = message.get_fields_and_field_types()
    for name, value in data.items():
        if name not in types:
            raise AttributeError(f"{type(message).__name__} has no field '{name}'")
        converted = value
        if isinstance(value, dict):
            converted = fill_message(getattr(message, name), value)
        elif isinstance(value, list) and "/" in types[name]:  # sequence<pkg/Name>
            item_type = types[name].removeprefix("sequence<").split(">")[0].split(",")[0]
            package, class_name = item_type.split("/")
            new = getattr(import_module(f"{package}.msg"), class_name)
            converted = [fill_message(new(), item) for item in value]
        elif types[name] == "double" and type(value) is int:  # as people write it
            converted = float(value)
        setattr(message, name, converted)
    return message
