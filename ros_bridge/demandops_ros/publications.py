"""Offers the bookkeeping over ROS 2, by a ROS service and on a latched topic.

The service and the topic carry the JSON that ``demandops bookkeeping --output json`` prints.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import datetime
from functools import partial
from typing import Any

from demandops.base.errors import DemandOpsError
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL
from demandops.repo.load.snapshot import Snapshot
from demandops.serve.generator import Generator
from demandops.views.bookkeeping import as_data, bookkeeping
from demandops_interfaces.msg import Bookkeeping as BookkeepingMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile

from demandops_ros.actions import OtherServers


def fill_response(generator: Generator, request: Any, response: Any) -> Any:  # noqa: ANN401
    """Fill the response with the bookkeeping at a revision or time, and return it.

    Without ``request.at``, that is the newest commit.
    """
    try:
        snapshot = generator.snapshot_at(request.at) if request.at else generator.snapshot
        response.commit, response.bookkeeping_json = _commit_and_json(snapshot)
        response.ok = True
    except DemandOpsError as error:
        response.ok, response.message = False, str(error)
    except Exception as error:  # the caller must get an answer
        REAL.failed("bookkeeping", error)
        response.ok, response.message = (
            False,
            one_line(f"internal error: {error!r}; see the node's log"),
        )
    return response


def _commit_and_json(snapshot: Snapshot) -> tuple[str, str]:
    commit = str(snapshot.commit)
    return commit, json.dumps(as_data(bookkeeping(snapshot.state), commit), ensure_ascii=False)


# A node that starts later gets the last message too.
_LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
_SHORTEST_PAUSE_S = 1.0
# The larger the ledger, the longer it takes to compute the bookkeeping. So this takes at most a
# 20th of the time, and changes during a pause share one message.
_PAUSE_FACTOR = 20


class BookkeepingTopic:
    """Publishes the bookkeeping on the topic ``~/bookkeeping``: at the start and on change."""

    def __init__(
        self, node: Node, generator: Generator, in_executor: Callable[[Callable[[], None]], None]
    ) -> None:
        self._generator = generator
        self._in_executor = in_executor
        self._publisher = node.create_publisher(BookkeepingMessage, "~/bookkeeping", _LATCHED)
        self._changed, self._closed = REAL.event(), REAL.event()
        self._changed.set()
        generator.on_publish(lambda config: self._changed.set())
        REAL.keep_running("bookkeeping-topic", self._run)

    def close(self) -> None:
        self._closed.set()
        self._changed.set()

    def _run(self) -> None:
        while self._changed.wait() and not self._closed.is_set():
            self._changed.clear()
            began = REAL.monotonic()
            commit, text = _commit_and_json(self._generator.snapshot)
            message = BookkeepingMessage(commit=commit, bookkeeping_json=text)
            self._in_executor(partial(self._publish, message))
            took = REAL.monotonic() - began
            self._closed.wait(max(_SHORTEST_PAUSE_S, took * _PAUSE_FACTOR))

    def _publish(self, message: Any) -> None:  # noqa: ANN401
        if not self._closed.is_set():  # else the node may be destroyed already
            self._publisher.publish(message)


# ---- the node's status on ``/diagnostics``, for ROS 2's own tools ----
#
# The node publishes four statuses once a second: whether the state repo can be reached and written,
# whether the configuration is valid, whether all parts of the generator work, and whether no other
# node serves the node's actions.

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
