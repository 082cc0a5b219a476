"""Messages as plain data. Knows no rclpy: any message of rosidl's Python will do."""

from __future__ import annotations

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
