"""The node's status on ``/diagnostics``, for ROS 2's own tools.

The node publishes four statuses once a second: whether the state repo can be reached and written,
whether the configuration is valid, whether all parts of the generator work, and whether no other
node serves the node's actions.
"""

from __future__ import annotations

from datetime import datetime

from demandops.quoting import one_line
from demandops.service import Generator
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from demandops_ros.action_endpoints import OtherServers

_PERIOD_S = 1.0
_MOST_PROBLEMS = 20


class Diagnostics:
    def __init__(self, node: Node, generator: Generator, others: OtherServers) -> None:
        self._node, self._generator, self._others = node, generator, others
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = node.create_timer(_PERIOD_S, self._publish)

    def _publish(self) -> None:
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        generator, address, statuses = self._generator, self._generator.address, []

        remote, unpublished = generator.remote_status, generator.unpublished
        level, text = DiagnosticStatus.OK, "reachable"
        if remote.push_denied:
            level, text = DiagnosticStatus.ERROR, remote.push_denied
        if remote.unreachable:
            # while no demand waits, an unreachable repo delays only people's changes
            level = DiagnosticStatus.ERROR if unpublished else DiagnosticStatus.WARN
            text = remote.unreachable
        values = {
            "reachable": str(not remote.unreachable).lower(),
            "away since": _time(remote.unreachable_since),
            "last reached": _time(remote.last_reached),
            "last push": _time(remote.last_push),
            "unpublished demands": str(unpublished),
            "commit": str(generator.snapshot.commit),
        }
        statuses.append(status("demandops: state repo", address, level, text, values))

        problems = generator.snapshot.problems
        level, text = DiagnosticStatus.OK, "all files are valid"
        if problems:
            level = DiagnosticStatus.WARN
            text = f"{len(problems)} problems; the last valid version is in effect"
        values = {"problems": str(len(problems))}
        for number, problem in enumerate(problems[:_MOST_PROBLEMS], start=1):
            values[f"problem {number}"] = str(problem)
        statuses.append(status("demandops: configuration", address, level, text, values))

        failures = generator.failures
        level, text = DiagnosticStatus.OK, "all parts work"
        if failures:
            level, text = DiagnosticStatus.ERROR, f"failing: {', '.join(failures)}; see the log"
        statuses.append(status("demandops: generator", address, level, text, failures))

        others = self._others.find()
        level, text = DiagnosticStatus.OK, "no other node serves these actions"
        if any(others.values()):
            level, text = (
                DiagnosticStatus.WARN,
                "another node serves these actions too; see the log",
            )
        values = {action: ", ".join(nodes) for action, nodes in others.items()}
        statuses.append(status("demandops: actions", address, level, text, values))

        message.status = statuses
        self._publisher.publish(message)


def status(
    name: str, address: str, level: bytes, text: str, values: dict[str, str]
) -> DiagnosticStatus:
    """Return a diagnostic status; its text, its keys and its values have no line breaks."""
    pairs = [KeyValue(key=one_line(key), value=one_line(value)) for key, value in values.items()]
    message = one_line(text)
    return DiagnosticStatus(
        level=level, name=name, message=message, hardware_id=address, values=pairs
    )


def _time(time: datetime | None) -> str:
    return time.isoformat(timespec="seconds") if time else "never"
