"""Offers the bookkeeping over ROS 2, by a ROS service and on a latched topic.

The service and the topic carry the JSON that ``demandops bookkeeping --output json`` prints.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import Any

from demandops.errors import DemandOpsError
from demandops.plan.views.bookkeeping import as_data, bookkeeping
from demandops.quoting import one_line
from demandops.runtime import REAL
from demandops.service import Generator
from demandops.staterepo.load.snapshot import Snapshot
from demandops_interfaces.msg import Bookkeeping as BookkeepingMessage
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile


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
