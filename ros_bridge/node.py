"""The ROS 2 node: an action server that hands demands to the generator.

Many goals may be under way: each waits for its receipt without holding the executor. What the
generator's worker thread tells (stages, receipts) is queued and handled in the executor's own
thread, woken by a guard condition.
"""

from __future__ import annotations

import uuid
from collections import deque
from collections.abc import Callable
from functools import partial
from threading import Thread
from typing import Any

from application_manager_interfaces.action import DeploymentRequest
from demandops_interfaces.srv import GetBookkeeping
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.task import Future

from generator.decision import explain
from generator.errors import DemandOpsError, InvalidInput, QueueFull, ShuttingDown, Withdrawn
from generator.service import Generator, Receipt
from ros_bridge.bookkeeping import answer
from ros_bridge.convert import as_data

QUEUE_DEPTH = 2000
"""Depth of the services' queues. With ROS's default of 10, goals that arrive together are lost."""

DEEP = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=QUEUE_DEPTH,
    reliability=QoSReliabilityPolicy.RELIABLE,
)


class DemandNode(Node):  # type: ignore[misc]
    """Serves ``DeploymentRequest`` for one state repo."""

    def __init__(self, generator: Generator, action_name: str, **options: Any) -> None:  # noqa: ANN401
        super().__init__("demandops", **options)
        self._generator = generator
        self._open: dict[str, ServerGoalHandle] = {}
        self._events: deque[Callable[[], None]] = deque()
        self._stopping = False
        # a group of its own: a service that waits for an event must not keep events from coming
        self._wake = self.create_guard_condition(
            self._handle_events, callback_group=MutuallyExclusiveCallbackGroup()
        )
        self._server = ActionServer(
            self,
            DeploymentRequest,
            action_name,
            execute_callback=self._execute,
            goal_callback=self._admit,
            cancel_callback=self._cancel,
            goal_service_qos_profile=DEEP,
            result_service_qos_profile=DEEP,
            cancel_service_qos_profile=DEEP,
            feedback_pub_qos_profile=DEEP,
        )
        self.create_service(
            GetBookkeeping,
            "~/get_bookkeeping",
            self._bookkeeping,
            callback_group=ReentrantCallbackGroup(),
        )

    @property
    def open_goals(self) -> int:
        """How many goals have no result yet."""
        return len(self._open)

    def stop_accepting(self) -> None:
        """Reject further goals; those under way go on."""
        self._stopping = True

    async def _bookkeeping(self, request: Any, response: Any) -> Any:  # noqa: ANN401
        """Answer from a thread of its own: an old revision may take seconds to read."""
        done = Future(executor=self.executor)

        def work() -> None:
            filled = answer(self._generator, request, response)
            self._from_worker(partial(done.set_result, filled))

        Thread(target=work, name="demandops-bookkeeping", daemon=True).start()
        return await done

    # ---- callbacks of the action server, in the executor's thread ----

    def _admit(self, goal: Any) -> GoalResponse:  # noqa: ANN401
        """Accept whatever can be decoded: a goal response carries no text to say why not."""
        if self._stopping:
            self.get_logger().warning(f"goal '{goal.id}' rejected: shutting down")
            return GoalResponse.REJECT
        if len(self._open) >= self._generator.queue_limit:
            self.get_logger().warning(f"goal '{goal.id}' rejected: too many are waiting")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        """A demand can be taken back until it is committed."""
        if self._generator.withdraw(_operation(handle)):
            return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    async def _execute(self, handle: ServerGoalHandle) -> Any:  # noqa: ANN401
        operation = _operation(handle)
        self._open[operation] = handle
        done = Future(executor=self.executor)
        try:
            ticket = self._generator.submit(
                as_data(handle.request),
                operation,
                lambda stage, text: self._from_worker(partial(self._feedback, handle, text)),
            )
        except (ShuttingDown, QueueFull) as error:
            return self._finish(handle, error)
        ticket.future.add_done_callback(
            lambda future: self._from_worker(partial(done.set_result, future))
        )
        outcome = (await done).exception() or ticket.future.result()
        return self._finish(handle, outcome)

    def _feedback(self, handle: ServerGoalHandle, text: str) -> None:
        if handle.is_active:
            handle.publish_feedback(DeploymentRequest.Feedback(message=text))

    def _finish(self, handle: ServerGoalHandle, outcome: Receipt | BaseException) -> Any:  # noqa: ANN401
        self._open.pop(_operation(handle), None)
        result = DeploymentRequest.Result()
        if isinstance(outcome, Receipt):
            result.message = _told(outcome)
            handle.succeed()
            self.get_logger().info(f"goal '{handle.request.id}': {result.message}")
        elif isinstance(outcome, Withdrawn) and handle.is_cancel_requested:
            result.message = str(outcome)
            handle.canceled()
            self.get_logger().info(f"goal '{handle.request.id}': cancelled")
        else:
            result.message = _reason(outcome)
            handle.abort()
            self.get_logger().error(f"goal '{handle.request.id}': {result.message}")
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


def _told(receipt: Receipt) -> str:
    """Return a receipt as the one line that a result carries."""
    lines = [f"{receipt.outcome}: {receipt.commit}"]
    lines += [f"warning: {warning}" for warning in receipt.warnings]
    lines += [f"not held: {item}" for item in receipt.not_held]
    return "\n".join(lines)


def _reason(error: BaseException) -> str:
    """Return why a goal is aborted, as ``<code>: <field>: <remedy>``, one line for each fault."""
    if isinstance(error, InvalidInput):
        return explain(error)
    if isinstance(error, ShuttingDown):
        return f"shutting-down: {error}"
    if isinstance(error, QueueFull):
        return f"queue-full: {error}"
    if isinstance(error, DemandOpsError):
        return f"state-repo: {error}"
    return f"fault: {error!r}"
