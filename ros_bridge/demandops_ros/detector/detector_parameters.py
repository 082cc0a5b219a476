"""The detector's parameters: their defaults, descriptions and ranges."""

from __future__ import annotations

from typing import Any

import click
from demandops.settings import DEFAULT_ACTION_NAME, DEFAULT_DEMAND_ACTION_NAME
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node

# Each parameter: its default, its description and, if it is a number, its range.
PARAMETERS: dict[str, tuple[Any, str, tuple[float, float] | None]] = {
    "rules": ("", "File of rules.", None),
    "action_name": (
        DEFAULT_ACTION_NAME,
        "Name of the action DeploymentRequest, for rules that send it.",
        None,
    ),
    "demand_action_name": (
        DEFAULT_DEMAND_ACTION_NAME,
        "Name of the action Demand, for rules that send it.",
        None,
    ),
    "bookkeeping_topic": (
        "/demandops/bookkeeping",
        "Topic of the bookkeeping that the detector reads at its start. Without a topic, the "
        "detector does not read the bookkeeping.",
        None,
    ),
    "settling_time": (
        10.0,
        "After the start or a change of the rules, an entity of a booked demand counts as gone if "
        "it stays unseen for this many seconds, or for the timeout of its source if that is "
        "longer.",
        (0.1, 3_600.0),
    ),
    "period": (0.1, "Seconds between two evaluations of received messages.", (0.01, 10.0)),
    "answer_timeout": (60.0, "How many seconds a goal may wait for its answer.", (1.0, 86_400.0)),
    "log_level": (
        "info",
        "Lowest level of messages in the log: debug, info, warn, error or fatal.",
        None,
    ),
}

LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")


def declare(node: Node, rules: str | None) -> dict[str, Any]:
    """Declare all parameters of a node, where ``rules`` is a default, and return their values."""
    values = {}
    for name, (default, description, span) in PARAMETERS.items():
        described = ParameterDescriptor(description=description, read_only=True)
        if span is not None:
            described.floating_point_range = [
                FloatingPointRange(from_value=span[0], to_value=span[1])
            ]
        given = rules if name == "rules" and rules else default
        try:
            values[name] = node.declare_parameter(name, given, described).value
        except ParameterException as error:
            raise click.UsageError(str(error)) from None
    if not values["rules"]:
        raise click.UsageError("no rules given; name a file, or set the ROS parameter 'rules'")
    if values["log_level"] not in LOG_LEVELS:
        raise click.UsageError(
            f"parameter log_level is '{values['log_level']}'; it takes {', '.join(LOG_LEVELS)}"
        )
    return values
