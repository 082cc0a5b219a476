"""How the node does, on ``/diagnostics``, as ROS 2's own tools read it.

Two states, once a second: of the state repo (can it be reached, does it take pushes, how much
waits for it), and of its configuration (is all of it valid). The generator knows both; this only
words them.
"""

from __future__ import annotations

from datetime import datetime

from demandops.service import Generator
from demandops.service.remote_status import StateRepoStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

PERIOD_S = 1.0
_MOST_PROBLEMS = 20


class Diagnostics:
    """Publishes the condition of a generator."""

    def __init__(self, node: Node, generator: Generator) -> None:
        self._node, self._generator = node, generator
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = node.create_timer(PERIOD_S, self._publish)

    def _publish(self) -> None:
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = statuses(self._generator.state_repo_status, self._generator.address)
        self._publisher.publish(message)


def statuses(condition: StateRepoStatus, address: str) -> list[DiagnosticStatus]:
    """Return the two states that a condition comes to."""
    return [_of_state_repo(condition, address), _of_configuration(condition, address)]


def _of_state_repo(condition: StateRepoStatus, address: str) -> DiagnosticStatus:
    contact = condition.remote
    level, text = DiagnosticStatus.OK, "reachable"
    if contact.push_denied:
        level, text = DiagnosticStatus.ERROR, contact.push_denied
    if contact.unreachable:
        # while nobody waits for it only people's changes are late
        level = DiagnosticStatus.ERROR if condition.unpublished else DiagnosticStatus.WARN
        text = contact.unreachable
    values = {
        "reachable": str(not contact.unreachable).lower(),
        "away since": _moment(contact.unreachable_since),
        "last reached": _moment(contact.last_reached),
        "last push": _moment(contact.last_push),
        "demands in the outbox": str(condition.unpublished),
        "commit": condition.commit,
    }
    return _status("demandops: state repo", address, level, text, values)


def _of_configuration(condition: StateRepoStatus, address: str) -> DiagnosticStatus:
    problems = [str(problem) for problem in condition.problems]
    level, text = DiagnosticStatus.OK, "all files are valid"
    if problems:
        level = DiagnosticStatus.WARN
        text = f"{len(problems)} problems; the last valid version is in force"
    values = {
        f"problem {number}": problem
        for number, problem in enumerate(problems[:_MOST_PROBLEMS], start=1)
    }
    values = {"problems": str(len(problems))} | values
    return _status("demandops: configuration", address, level, text, values)


def _status(
    name: str, address: str, level: bytes, text: str, values: dict[str, str]
) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=text, hardware_id=address, values=pairs)


def _moment(moment: datetime | None) -> str:
    return moment.isoformat(timespec="seconds") if moment else "never"
