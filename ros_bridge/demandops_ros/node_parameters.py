"""The node's parameters: their defaults, descriptions and ranges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click
from demandops.service.timing.polling import DEFAULT_INTERVAL, parse_interval
from demandops.settings import (
    DEFAULT_ACTION_NAME,
    DEFAULT_DEMAND_ACTION_NAME,
    QUEUE_LIMIT,
    REQUESTER_QUEUE_LIMIT,
)
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from demandops_ros.messages import ANSWER_LEVELS

_CHOICES = {
    "answer": ANSWER_LEVELS,
    "log_level": ("debug", "info", "warn", "error", "fatal"),
}
DEFAULTS: dict[str, Any] = {
    "action_name": DEFAULT_ACTION_NAME,
    "demand_action_name": DEFAULT_DEMAND_ACTION_NAME,
    "answer": ANSWER_LEVELS[0],
    "answer_timeout": 120.0,
    "state_repo": "",
    "fetch_interval": DEFAULT_INTERVAL,
    "requester_queue_limit": REQUESTER_QUEUE_LIMIT,
    "log_level": "info",
}
_DESCRIPTIONS = {
    "action_name": "Name of the action DeploymentRequest, which the reference's clients use.",
    "demand_action_name": "Name of the action Demand.",
    "answer": "When a DeploymentRequest is answered.",
    "answer_timeout": "How many seconds a goal may take to be reconciled or healthy.",
    "state_repo": "Folder or URL of the state repo.",
    "fetch_interval": "How often people's commits are fetched while no demand comes; 0 means no "
    "fetches at an interval.",
    "requester_queue_limit": "How many demands of one requester may be without an answer; more "
    "are rejected.",
    "log_level": "Lowest level of messages in the log.",
}

_RANGES = {
    "answer_timeout": {
        "floating_point_range": [FloatingPointRange(from_value=0.001, to_value=86_400.0)]
    },
    "requester_queue_limit": {
        "integer_range": [IntegerRange(from_value=1, to_value=QUEUE_LIMIT, step=1)]
    },
}


def read(given: Mapping[str, str | None]) -> dict[str, Any]:
    """Return all values; ``given`` replaces defaults, and the ROS arguments replace both."""
    # a temporary node reads them, because the generator starts before the node
    defaults = DEFAULTS | {name: value for name, value in given.items() if value}
    probe = Node("demandops", start_parameter_services=False, enable_rosout=False)
    try:
        values = {
            name: probe.declare_parameter(name, default, descriptor(name)).value
            for name, default in defaults.items()
        }
    except ParameterException as error:
        raise click.UsageError(str(error)) from None
    finally:
        probe.destroy_node()
    interval = values["fetch_interval"]  # ROS reads 30 as a number and 30s as text
    values["fetch_interval"] = f"{interval:g}" if isinstance(interval, float) else str(interval)
    if not values["state_repo"]:
        raise click.UsageError(
            "no state repo given; use --state-repo URL_OR_DIR, DEMANDOPS_STATE_REPO or the ROS "
            "parameter state_repo"
        )
    try:
        parse_interval(values["fetch_interval"])
    except ValueError as error:
        raise click.UsageError(f"fetch interval: {error}") from None
    for name, choices in _CHOICES.items():
        if values[name] not in choices:
            raise click.UsageError(
                f"parameter {name} is '{values[name]}'; it takes {', '.join(choices)}"
            )
    return values


def descriptor(name: str, *, read_only: bool = False) -> ParameterDescriptor:
    """Return a parameter's descriptor; only ``fetch_interval`` may be of any type."""
    choices = _CHOICES.get(name)
    return ParameterDescriptor(
        description=_DESCRIPTIONS[name],
        additional_constraints=f"one of {', '.join(choices)}" if choices else "",
        read_only=read_only,
        dynamic_typing=name == "fetch_interval",
        **_RANGES.get(name, {}),
    )
