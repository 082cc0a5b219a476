"""The ROS 2 node: action servers that submit demands to the generator.

Many goals may be open: each waits for its receipt without blocking the executor. Stages and
receipts from the generator's worker thread are queued, and a guard condition wakes the executor to
handle them.
"""

from __future__ import annotations

import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from demandops.cluster.health.release_health import Level
from demandops.cluster.rollout_watcher import RolloutWatcher
from demandops.errors import NotReached, QueueFull, ShuttingDown, Withdrawn
from demandops.runtime import REAL
from demandops.service import Generator, Receipt
from demandops_interfaces.srv import GetBookkeeping
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.task import Future

from demandops_ros.actions import ActionAdapter, DemandAdapter, DeploymentRequestAdapter
from demandops_ros.bookkeeping_topic import BookkeepingTopic, fill_response
from demandops_ros.diagnostics import Diagnostics

QUEUE_DEPTH = 2000
"""Depth of the services' queues: with ROS's default of 10, goals that arrive at once are lost."""

DEEP_QOS = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=QUEUE_DEPTH,
    reliability=QoSReliabilityPolicy.RELIABLE,
)


@dataclass(frozen=True, slots=True)
class AnswerSettings:
    """When to answer goals: at ``level`` if the goal names none, after ``timeout_s`` at the latest.

    ``status`` watches rollouts; None without access to the clusters.
    """

    level: Level = "pushed"
    timeout_s: float = 120.0
    status: RolloutWatcher | None = None


class DemandNode(Node):  # type: ignore[misc]
    """Serves ``DeploymentRequest`` and ``Demand`` for one state repo."""

    def __init__(
        self,
        generator: Generator,
        action_name: str,
        demand_action_name: str,
        answers: AnswerSettings,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__("demandops", **options)
        self._generator = generator
        self._answer_settings = answers
        self._open: dict[str, ServerGoalHandle] = {}
        self._events: deque[Callable[[], None]] = deque()
        self._stopping = False
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
        self._diagnostics = Diagnostics(self, generator)

    def _serve(self, adapter: ActionAdapter, name: str) -> ActionServer:
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
        done = Future(executor=self.executor)

        def work() -> None:
            filled = fill_response(self._generator, request, response)
            self._from_worker(partial(done.set_result, filled))

        REAL.start_thread("bookkeeping", work)
        return await done

    # ---- callbacks of the action server, in the executor's thread ----

    def _accept_or_reject(self, adapter: ActionAdapter, goal: Any) -> GoalResponse:  # noqa: ANN401
        """Accept every goal unless overloaded: a rejection cannot carry a reason, a result can."""
        reason = "shutting down" if self._stopping else ""
        if len(self._open) >= self._generator.queue_limit:
            reason = "too many are waiting"
            unreachable = self._generator.state_repo_status.remote.unreachable
            reason += f" for the state repo: {unreachable}" if unreachable else ""
        if reason:
            self.get_logger().warning(f"goal '{adapter.name(goal)}' rejected: {reason}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        """Withdraw a demand, which is possible until it is committed."""
        if self._generator.withdraw(_operation(handle)):
            return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    async def _execute(self, adapter: ActionAdapter, handle: ServerGoalHandle) -> Any:  # noqa: ANN401
        operation = _operation(handle)
        self._open[operation] = handle
        done = Future(executor=self.executor)
        try:
            ticket = self._generator.submit(
                adapter.to_data(handle.request),
                operation,
                lambda stage, text: self._from_worker(
                    partial(self._feedback, adapter, handle, stage, text)
                ),
            )
        except (ShuttingDown, QueueFull) as error:
            return self._finish(adapter, handle, error)
        ticket.future.add_done_callback(
            lambda future: self._from_worker(partial(done.set_result, future))
        )
        outcome = (await done).exception() or ticket.future.result()
        level = adapter.answer_level(handle.request) or self._answer_settings.level
        if not isinstance(outcome, Receipt) or level == "pushed":
            return self._finish(adapter, handle, outcome)
        problem = self._cannot_watch(outcome)
        if problem:
            outcome = replace(outcome, warnings=(*outcome.warnings, problem))
            return self._finish(adapter, handle, outcome)
        return self._finish(
            adapter, handle, await self._wait_for_rollout(adapter, handle, outcome, level), level
        )

    def _cannot_watch(self, receipt: Receipt) -> str:
        """Return why the rollout of a demand cannot be watched, or empty."""
        if self._answer_settings.status is None:
            return "answered at pushed: this node has no access to the clusters"
        problem = self._answer_settings.status.why_unreachable(
            target.domain for target in receipt.targets
        )
        return f"answered at pushed: {problem}" if problem else ""

    async def _wait_for_rollout(
        self, adapter: ActionAdapter, handle: ServerGoalHandle, receipt: Receipt, level: Level
    ) -> Receipt | NotReached:
        """Wait until a rollout reaches a level, or for the time limit."""
        assert self._answer_settings.status is not None  # noqa: S101 - the caller has checked
        done = Future(executor=self.executor)
        followed = self._answer_settings.status.follow(
            receipt.commit,
            receipt.targets,
            level,
            self._answer_settings.timeout_s,
            lambda stage, text: self._from_worker(
                partial(self._feedback, adapter, handle, stage, text)
            ),
        )
        followed.add_done_callback(
            lambda future: self._from_worker(partial(done.set_result, future.result()))
        )
        health = await done
        if health.reaches(level):
            return receipt
        prefix = f"{health.object}: " if health.object else ""
        return NotReached(level, f"{prefix}{health.reason}; it is booked in {receipt.commit}")

    def _feedback(
        self, adapter: ActionAdapter, handle: ServerGoalHandle, stage: str, text: str
    ) -> None:
        if handle.is_active:
            handle.publish_feedback(adapter.feedback(stage, text))

    def _finish(
        self,
        adapter: ActionAdapter,
        handle: ServerGoalHandle,
        outcome: Receipt | BaseException,
        reached: Level = "pushed",
    ) -> Any:  # noqa: ANN401
        self._open.pop(_operation(handle), None)
        result = adapter.result(outcome, reached)
        prefix = f"goal '{adapter.name(handle.request)}': "
        if isinstance(outcome, Receipt):
            handle.succeed()
            self.get_logger().info(prefix + result.message)
        elif isinstance(outcome, Withdrawn) and handle.is_cancel_requested:
            handle.canceled()
            self.get_logger().info(prefix + "cancelled")
        else:
            handle.abort()
            self.get_logger().error(prefix + result.message)
        return result

    # ---- from the worker thread into the executor's ----

    def _from_worker(self, event: Callable[[], None]) -> None:
        self._events.append(event)
        self._wake.trigger()

    def _handle_events(self) -> None:
        while self._events:
            self._events.popleft()()


def _operation(handle: ServerGoalHandle) -> str:
    return str(uuid.UUID(bytes=bytes(handle.goal_id.uuid)))
