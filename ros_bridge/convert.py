"""Messages as plain data. Knows no rclpy: any message of rosidl's Python will do."""

from __future__ import annotations

from importlib import import_module
from typing import Any


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
