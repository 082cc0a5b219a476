"""The ROS 2 node: action servers that submit demands to the generator.

Many goals may be open: each waits for its receipt without blocking the executor. Stages and
receipts from the generator's worker thread are queued, and a guard condition wakes the executor to
handle them.
"""

from __future__ import annotations

import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from demandops.cluster.health.release_health import Level
from demandops.cluster.rollout_watcher import RolloutWatcher
from demandops.errors import NotReached, QueueFull, ShuttingDown, Unsound, Withdrawn
from demandops.quoting import one_line, quoted
from demandops.runtime import REAL
from demandops.service import Generator, Receipt
from demandops_interfaces.srv import GetBookkeeping
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future

from demandops_ros.action_endpoints import DEEP_QOS, OtherServers
from demandops_ros.actions import DemandAdapter, DeploymentRequestAdapter
from demandops_ros.bookkeeping_topic import BookkeepingTopic, fill_response
from demandops_ros.diagnostics import Diagnostics

_RESULT_KEPT_S = 900
"""How long a client may ask for a result; rclpy keeps it for ten seconds."""
_MOST_READERS = 4
"""How many calls of the bookkeeping's service to answer at once; each may read all of history."""


class DemandNode(Node):  # type: ignore[misc]
    """Serves ``DeploymentRequest`` and ``Demand`` for one state repo."""

    def __init__(
        self,
        generator: Generator,
        action_name: str,
        demand_action_name: str,
        level: Level,
        timeout_s: float,
        status: RolloutWatcher | None,
    ) -> None:
        """Start the servers.

        Args:
            generator: takes the demands.
            action_name, demand_action_name: the names of the two actions.
            level: when to answer a goal that names no level.
            timeout_s: after how many seconds to answer in any case.
            status: watches rollouts; None without access to the clusters.
        """
        super().__init__("demandops")
        self._generator = generator
        self._level, self._timeout_s, self._status = level, timeout_s, status
        self._open: dict[str, ServerGoalHandle] = {}
        self._events: deque[Callable[[], None]] = deque()
        self._stopping = False
        self._readers = 0
        # a group of its own, so that a service that waits for an event does not block events
        self._wake = self.create_guard_condition(
            self._handle_events, callback_group=MutuallyExclusiveCallbackGroup()
        )
        self._servers = [
            self._serve(DeploymentRequestAdapter(), action_name),
            self._serve(DemandAdapter(), demand_action_name),
        ]
        self.create_service(
            GetBookkeeping,
            "~/get_bookkeeping",
            self._bookkeeping,
            callback_group=ReentrantCallbackGroup(),
        )
        self._bookkeeping_topic = BookkeepingTopic(self, generator, self._from_worker)
        others = OtherServers(self, (action_name, demand_action_name))
        self._diagnostics = Diagnostics(self, generator, others)

    def _serve(self, adapter: DeploymentRequestAdapter, name: str) -> ActionServer:
        return ActionServer(
            self,
            adapter.action,
            name,
            execute_callback=partial(self._execute, adapter),
            goal_callback=partial(self._accept_or_reject, adapter),
            cancel_callback=self._cancel,
            goal_service_qos_profile=DEEP_QOS,
            result_service_qos_profile=DEEP_QOS,
            cancel_service_qos_profile=DEEP_QOS,
            feedback_pub_qos_profile=DEEP_QOS,
            result_timeout=_RESULT_KEPT_S,
        )

    def close(self) -> None:
        """Stop the threads beside the executor."""
        self._bookkeeping_topic.close()

    @property
    def open_goals(self) -> int:
        """How many goals have no result yet."""
        return len(self._open)

    def stop_accepting(self) -> None:
        """Reject further goals; open goals continue."""
        self._stopping = True

    async def _bookkeeping(self, request: Any, response: Any) -> Any:  # noqa: ANN401
        """Answer from a thread of its own: an old revision may take seconds to read."""
        if self._readers >= _MOST_READERS:
            response.message = f"{_MOST_READERS} calls are answered already; try again later"
            return response
        self._readers += 1
        done = Future(executor=self.executor)

        def work() -> None:
            filled = fill_response(self._generator, request, response)
            self._from_worker(partial(done.set_result, filled))

        REAL.start_thread("bookkeeping", work)
        try:
            return await done
        finally:
            self._readers -= 1

    # ---- callbacks of the action server, in the executor's thread ----

    def _accept_or_reject(self, adapter: DeploymentRequestAdapter, goal: Any) -> GoalResponse:  # noqa: ANN401
        """Accept every goal unless overloaded: a rejection cannot carry a reason, a result can."""
        reason = "shutting down" if self._stopping else ""
        if len(self._open) >= self._generator.queue_limit:
            reason = "too many are waiting"
            unreachable = self._generator.remote_status.unreachable
            reason += f" for the state repo: {unreachable}" if unreachable else ""
        if reason:
            self.get_logger().warning(f"goal {quoted(adapter.name(goal))} rejected: {reason}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        """Withdraw a demand, which is possible until it is committed."""
        if self._generator.withdraw(_operation(handle)):
            return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    async def _execute(self, adapter: DeploymentRequestAdapter, handle: ServerGoalHandle) -> Any:  # noqa: ANN401
        """Return the result of a goal; an internal error is a result too."""
        self._open[_operation(handle)] = handle
        try:
            return await self._answer(adapter, handle)
        except Exception as error:
            REAL.failed(f"goal of {adapter.action.__name__}", error)
            return self._finish(adapter, handle, error)
        finally:
            self._open.pop(_operation(handle), None)

    async def _answer(self, adapter: DeploymentRequestAdapter, handle: ServerGoalHandle) -> Any:  # noqa: ANN401
        operation, goal = _operation(handle), handle.request
        done = Future(executor=self.executor)

        def notify(stage: str, text: str) -> None:
            self._from_worker(partial(_give_feedback, handle, adapter.feedback(stage, text)))

        try:
            ticket = self._generator.submit(adapter.to_data(goal), operation, notify)
        except (ShuttingDown, QueueFull) as error:
            return self._finish(adapter, handle, error)
        ticket.future.add_done_callback(
            lambda future: self._from_worker(partial(done.set_result, future))
        )
        outcome = (await done).exception() or ticket.future.result()
        if isinstance(outcome, Unsound):  # nobody may be told anything; the process ends
            await Future(executor=self.executor)
        level = adapter.answer_level(goal) or self._level
        if not isinstance(outcome, Receipt) or level == "pushed":
            return self._finish(adapter, handle, outcome)
        status, problem = self._status, "this node has no access to the clusters"
        if status is not None:
            problem = status.why_unreachable(target.domain for target in outcome.targets)
        if problem or status is None:
            warnings = (*outcome.warnings, f"answered at pushed: {problem}")
            return self._finish(adapter, handle, replace(outcome, warnings=warnings))
        rolled_out = Future(executor=self.executor)
        status.follow(
            outcome.commit, outcome.targets, level, self._timeout_s, notify
        ).add_done_callback(
            lambda future: self._from_worker(partial(rolled_out.set_result, future.result()))
        )
        health = await rolled_out
        if health.reaches(level):
            return self._finish(adapter, handle, outcome, level)
        prefix = f"{health.object}: " if health.object else ""
        message = f"{prefix}{health.reason}; it is booked in {outcome.commit}"
        return self._finish(adapter, handle, NotReached(level, message))

    def _finish(
        self,
        adapter: DeploymentRequestAdapter,
        handle: ServerGoalHandle,
        outcome: Receipt | BaseException,
        reached: Level = "pushed",
    ) -> Any:  # noqa: ANN401
        result = adapter.result(outcome, reached)
        text = one_line(result.message.replace("\n", "; "))
        prefix = f"goal {quoted(adapter.name(handle.request))}: "
        if isinstance(outcome, Receipt):
            handle.succeed()
            self.get_logger().info(prefix + text)
        elif isinstance(outcome, Withdrawn) and handle.is_cancel_requested:
            handle.canceled()
            self.get_logger().info(prefix + "cancelled")
        else:
            handle.abort()
            self.get_logger().error(prefix + text)
        return result

    # ---- from the worker thread into the executor's ----

    def _from_worker(self, event: Callable[[], None]) -> None:
        self._events.append(event)
        self._wake.trigger()

    def _handle_events(self) -> None:
        while self._events:
            try:
                self._events.popleft()()
            except Exception as error:  # the other goals must get their events
                REAL.failed("events of goals", error)


def _operation(handle: ServerGoalHandle) -> str:
    return str(uuid.UUID(bytes=bytes(handle.goal_id.uuid)))


def _give_feedback(handle: ServerGoalHandle, feedback: Any) -> None:  # noqa: ANN401
    if handle.is_active:
        handle.publish_feedback(feedback)
