"""Helpers of all stand-ins: find a message type by name; spin a node until a signal comes."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import rclpy
from demandops_ros.ros_process import ExecutorThread, StopSignals
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions


def message_class(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def start(args: list[str] | None = None, domain: int | None = None) -> None:
    """Initialize ROS without its own signal handlers, because :func:`spin` handles the signals."""
    rclpy.init(args=args or [], domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)


def spin(node: Node) -> None:
    """Run a node's callbacks until Ctrl-C or SIGTERM, then shut ROS down."""
    with StopSignals() as signals:
        thread = ExecutorThread(node)
        signals.wait()
        thread.close()
    rclpy.try_shutdown()
