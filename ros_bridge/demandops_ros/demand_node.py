"""The ROS 2 node: action servers, bookkeeping and diagnostics."""

from __future__ import annotations

import json
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from typing import Any, TypeGuard

import click
from demandops.base.errors import DemandOpsError, InvalidInput, NotReached, Unsound, Withdrawn
from demandops.base.quoting import one_line, quoted
from demandops.base.runtime import REAL
from demandops.cluster.health import Health, Level
from demandops.cluster.rollouts import RolloutWatcher
from demandops.decide.bookkeeping import as_data, bookkeeping
from demandops.repo.load.snapshot import Snapshot
from demandops.serve.generator import Generator
from demandops.serve.journal import Receipt, Ticket
from demandops_interfaces.msg import Bookkeeping as BookkeepingMessage
from demandops_interfaces.srv import GetBookkeeping
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rclpy.task import Future

from demandops_ros import actions
from demandops_ros.actions import DeploymentRequestAdapter, LastingResults

# ---- the bookkeeping over ROS 2, by a ROS service and on a latched topic ----
#
# Both carry the JSON that ``demandops bookkeeping --output json`` prints.


def _commit_and_json(snapshot: Snapshot) -> tuple[str, str]:
    commit = str(snapshot.commit)
    return commit, json.dumps(as_data(bookkeeping(snapshot.state), commit), ensure_ascii=False)


# A node that starts later gets the last message too.
LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
# The larger the ledger, the longer it takes to compute the bookkeeping. So this takes at most a
# 20th of the time, and changes during a pause share one message.
_PAUSE_FACTOR = 20

# ---- the node's status on ``/diagnostics``, for ROS 2's own tools ----

_MOST_PROBLEMS = 20


class Diagnostics:
    def __init__(self, node: Node, name: str, subject: str) -> None:
        self._node, self._name, self._subject = node, name, subject
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._statuses: list[DiagnosticStatus] = []

    def add(
        self, part: str, text: str, values: dict[str, str], *, warning: str = "", error: str = ""
    ) -> None:
        """Add the status of a part; ``text`` says how it is if there is no warning and no error."""
        fine = DiagnosticStatus.WARN if warning else DiagnosticStatus.OK
        status = DiagnosticStatus(level=DiagnosticStatus.ERROR if error else fine)
        status.name, status.hardware_id = f"{self._name}: {part}", self._subject
        status.message = one_line(error or warning or text)
        status.values = [
            KeyValue(key=one_line(key), value=one_line(value)) for key, value in values.items()
        ]
        self._statuses.append(status)

    def publish(self) -> None:
        message = DiagnosticArray(status=self._statuses)
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
        self._statuses = []


def _time(time: datetime | None) -> str:
    return time.isoformat(timespec="seconds") if time else "never"


# ---- the node: action servers that submit demands to the generator ----
#
# Many goals may be open without blocking the executor, because events from the generator's threads
# are queued, and a guard condition wakes the executor to handle them. The execute callback of a
# goal runs only once the goal's outcome is known.

# How many answers ROS 2 queues for a client by default; if more arrive, the oldest are lost.
_DEFAULT_DEPTH = 10
_SHALLOW = (
    f"more than {_DEFAULT_DEPTH} goals of all clients are open: a client with ROS 2's default "
    f"queue of {_DEFAULT_DEPTH} may miss results; give the client a deeper queue (docs/demand.md)"
)
# How many calls of the bookkeeping service may wait for their answers. Each may read the whole
# history. They are answered one after the other, because several computing threads would delay the
# demands much longer.
_MOST_READERS = 4


@dataclass(eq=False)
class _Goal:
    adapter: DeploymentRequestAdapter
    message: Any
    ticket: Ticket = field(init=False)
    handle: Any = None  # after the acceptance
    outcome: Receipt | BaseException = field(init=False)
    reached: Level = "pushed"
    feedback: list[Any] = field(default_factory=list)  # that was made before the handle exists
    is_refused: bool = False

    def __str__(self) -> str:
        return f"goal {quoted(self.adapter.name(self.message))}"


def awaits_releases(outcome: Receipt | BaseException, level: Level) -> TypeGuard[Receipt]:
    # a waiting demand has no releases yet
    return isinstance(outcome, Receipt) and level != "pushed" and outcome.outcome != "waiting"


def rollout_answer(
    receipt: Receipt, level: Level, health: Health
) -> tuple[Receipt | NotReached, Level]:
    if health.reaches(level):
        return receipt, level
    prefix = f"{health.object}: " if health.object else ""
    message = f"{prefix}{health.reason}; the demand is {receipt.outcome} in {receipt.commit}"
    return NotReached(level, message), "pushed"


class DemandNode(Node):  # type: ignore[misc]
    def __init__(
        self,
        generator: Generator,
        action_name: str,
        demand_action_name: str,
        level: Level,
        timeout_s: float,
        status: RolloutWatcher | None,
        *,
        ignores_ids: bool,
    ) -> None:
        # ``level`` is for goals that name none; ``timeout_s`` limits a rollout; ``ignores_ids``
        # concerns DeploymentRequests
        super().__init__("demandops")
        self._generator = generator
        self._level, self._timeout_s, self._status = level, timeout_s, status
        # The goals without a result, by `id()` of their messages: rclpy has no other name for a
        # goal that all its callbacks get.
        self._goals: dict[int, _Goal] = {}
        self._events: deque[Callable[[], None]] = deque()
        self._readers = 0
        self._last_reading: Future | None = None
        # a separate callback group, so that a waiting service call does not block the events
        self._wake = self.create_guard_condition(
            self._handle_events, callback_group=MutuallyExclusiveCallbackGroup()
        )
        self._servers = [
            self._serve(DeploymentRequestAdapter(ignores_ids=ignores_ids), action_name),
            self._serve(actions.DemandAdapter(), demand_action_name),
        ]
        self.create_service(
            GetBookkeeping,
            "~/get_bookkeeping",
            self._bookkeeping,
            callback_group=ReentrantCallbackGroup(),
        )
        self._bookkeeping_topic = self.create_publisher(
            BookkeepingMessage, "~/bookkeeping", LATCHED
        )
        self._has_news, self._is_closed = REAL.event(), REAL.event()
        self._has_news.set()
        generator.on_publish(lambda config: self._has_news.set())
        REAL.keep_running("bookkeeping-topic", self._publish_bookkeeping)
        self._others = actions.OtherServers(self, (action_name, demand_action_name))
        self._diagnostics = Diagnostics(self, "demandops", generator.address)
        self.create_timer(1.0, self._report)

    def _serve(self, adapter: DeploymentRequestAdapter, name: str) -> LastingResults:
        try:
            return LastingResults(
                self,
                adapter.action,
                name,
                execute_callback=self._execute,
                goal_callback=partial(self._accept_or_reject, adapter),
                handle_accepted_callback=self._accepted,
                cancel_callback=self._cancel,
                callback_group=ReentrantCallbackGroup(),  # goals arrive while others are journaled
                **actions.DEEP_SERVICES,
                feedback_pub_qos_profile=actions.DEEP_QOS,
            )
        except ValueError as error:  # such as remapping rules that give both actions one name
            raise click.UsageError(f"ROS does not take {name}: {one_line(str(error))}") from None

    def close(self) -> None:
        self._is_closed.set()
        self._has_news.set()

    @property
    def open_goals(self) -> int:
        return len(self._goals)

    async def _bookkeeping(self, request: Any, response: Any) -> Any:  # noqa: ANN401
        if self._readers >= _MOST_READERS:
            response.message = f"{_MOST_READERS} calls are being answered; try again later"
            return response
        # in another thread, because a call that reads an old revision may take seconds
        before, done = self._last_reading, Future(executor=self.executor)

        def work() -> None:
            try:
                # at a revision or time; without one, at the newest commit
                generator, at = self._generator, request.at
                snapshot = generator.snapshot_at(at) if at else generator.snapshot
                response.commit, response.bookkeeping_json = _commit_and_json(snapshot)
                response.ok = True
            except DemandOpsError as error:
                response.ok, response.message = False, str(error)
            except Exception as error:  # the caller must get an answer
                REAL.failed("bookkeeping", error)
                response.ok = False
                response.message = one_line(f"internal error: {error!r}; see the node's log")
            self._in_executor(partial(done.set_result, response))

        self._readers, self._last_reading = self._readers + 1, done
        try:
            if before is not None and not before.done():
                await before
            REAL.start_thread("bookkeeping", work)
            return await done
        finally:
            self._readers -= 1
            if not done.done():  # the thread did not start
                done.set_result(None)

    def _publish_bookkeeping(self) -> None:
        # at the start and after each publication
        while self._has_news.wait() and not self._is_closed.is_set():
            self._has_news.clear()
            began = REAL.monotonic()
            commit, text = _commit_and_json(self._generator.snapshot)
            message = BookkeepingMessage(commit=commit, bookkeeping_json=text)

            def publish(message: Any = message) -> None:  # noqa: ANN401
                if not self._is_closed.is_set():  # else the node may be destroyed already
                    self._bookkeeping_topic.publish(message)

            self._in_executor(publish)
            took = REAL.monotonic() - began
            self._is_closed.wait(max(1.0, took * _PAUSE_FACTOR))

    def _report(self) -> None:
        generator, add = self._generator, self._diagnostics.add
        remote, unpublished = generator.remote_status, generator.unpublished
        away, error = remote.unreachable, remote.push_denied
        if away:  # while no demand waits, an unreachable repo delays only people's changes
            error = away if unpublished else ""
        values = {
            "reachable": str(not away).lower(),
            "away since": _time(remote.unreachable_since),
            "last reached": _time(remote.last_reached),
            "last push": _time(remote.last_push),
            "unpublished demands": str(unpublished),
            "commit": str(generator.snapshot.commit),
        }
        add("state repo", "reachable", values, warning=away, error=error)

        problems, warning = generator.snapshot.problems, ""
        if problems:
            held = str(generator.snapshot.configuration)[:10]
            warning = f"{len(problems)} problems; the configuration of commit {held} is in effect"
        values = {"problems": str(len(problems))}
        for number, problem in enumerate(problems[:_MOST_PROBLEMS], start=1):
            values[f"problem {number}"] = str(problem)
        add("configuration", "all files are valid", values, warning=warning)

        failures = generator.failures
        error = f"failing: {', '.join(failures)}; see the log" if failures else ""
        add("generator", "all parts work", failures, error=error)

        others = {action: ", ".join(nodes) for action, nodes in self._others.find().items()}
        warning = "another node serves these actions too; see the log"
        warning = warning if any(others.values()) else ""
        add("actions", "no other node serves these actions", others, warning=warning)
        self._diagnostics.publish()

    # ---- callbacks of the action server, in the executor's thread ----

    async def _accept_or_reject(
        self,
        adapter: DeploymentRequestAdapter,
        message: Any,  # noqa: ANN401
    ) -> GoalResponse:
        # A goal is accepted once its demand is in the journal, so that no crash loses it. An
        # invalid goal is accepted too, because a result can contain the reason, but a rejection
        # cannot. Goals that arrive while the journal syncs share the next sync.
        goal = self._goals[id(message)] = _Goal(adapter, message)
        journaled = Future(executor=self.executor)
        try:
            goal.ticket = self._generator.submit(
                adapter.to_data(message), listener=partial(self._tell, goal)
            )
            goal.ticket.journaled.add_done_callback(
                lambda future: self._in_executor(partial(journaled.set_result, future.result()))
            )
            is_journaled = await journaled
            error = None if is_journaled else goal.ticket.future.exception()
            if is_journaled or isinstance(error, InvalidInput):
                if len(self._goals) > _DEFAULT_DEPTH:  # not ==, because goals may come in bursts
                    self.get_logger().warning(_SHALLOW, once=True)
                self.executor.create_task(self._forget_unless_accepted, goal)
                return GoalResponse.ACCEPT
            if isinstance(error, Unsound):  # send no answer: the process ends
                await Future(executor=self.executor)
            self.get_logger().error(f"{goal} rejected: {one_line(str(error))}")
        except Exception as error:
            REAL.failed(f"acceptance of {adapter.action.__name__}", error)
        del self._goals[id(message)]
        return GoalResponse.REJECT

    def _accepted(self, handle: ServerGoalHandle) -> None:
        goal = self._goals[id(handle.request)]
        goal.handle = handle  # which rclpy makes only now
        for feedback in goal.feedback:
            handle.publish_feedback(feedback)
        goal_id = uuid.UUID(bytes=bytes(handle.goal_id.uuid))
        self.get_logger().debug(f"{goal} ({goal_id}) is demand {goal.ticket.operation}")
        self._after(goal, goal.ticket.future, self._answer)

    def _forget_unless_accepted(self, goal: _Goal) -> None:
        if goal.handle is None:  # the acceptance did not reach the client
            del self._goals[id(goal.message)]
            self.get_logger().warning(
                f"{goal}: its client did not get the acceptance and will get no result; demand "
                f"{goal.ticket.operation} is still carried out"
            )

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        goal = self._goals.get(id(handle.request))
        if goal is not None and self._generator.withdraw(goal.ticket.operation):
            return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    def _execute(self, handle: ServerGoalHandle) -> Any:  # noqa: ANN401
        goal = self._goals.pop(id(handle.request))
        outcome = goal.outcome
        result = goal.adapter.result(outcome, goal.reached)
        text = _one_line(result.message)
        if isinstance(outcome, Receipt):
            handle.succeed()
            self.get_logger().info(f"{goal}: {text}")
        elif isinstance(outcome, Withdrawn) and handle.is_cancel_requested:
            handle.canceled()
            self.get_logger().info(f"{goal}: cancelled")
        else:
            handle.abort()
            if not goal.is_refused:  # a refusal is already in the log
                self.get_logger().error(f"{goal}: {text}")
        return result

    # ---- an accepted goal, in the executor's thread ----

    def _after(self, goal: _Goal, future: Any, step: Callable[[_Goal, Any], None]) -> None:  # noqa: ANN401
        # a coroutine would be slower: rclpy's executor resumes all waiting ones at each event
        def take() -> None:
            try:
                step(goal, future.exception() or future.result())
            except Exception as error:
                REAL.failed(f"goal of {goal.adapter.action.__name__}", error)
                self._finish(goal, error)

        future.add_done_callback(lambda _: self._in_executor(take))

    def _answer(self, goal: _Goal, outcome: Receipt | BaseException) -> None:
        if isinstance(outcome, Unsound):  # send no answer: the process ends
            return
        level = goal.adapter.answer_level(goal.message) or self._level
        if not awaits_releases(outcome, level):
            self._finish(goal, outcome)
            return
        status, problem = self._status, "this node has no access to the clusters"
        if status is not None:
            problem = status.why_unreachable(target.domain for target in outcome.targets)
        if problem or status is None:
            warning = f"the goal is answered at 'pushed', and not at '{level}': {problem}"
            self._finish(goal, replace(outcome, warnings=(*outcome.warnings, warning)))
            return
        rolled_out = status.follow(
            outcome.commit, outcome.targets, level, self._timeout_s, partial(self._tell, goal)
        )

        def answer(goal: _Goal, health: Health) -> None:
            self._finish(goal, *rollout_answer(outcome, level, health))

        self._after(goal, rolled_out, answer)

    def _finish(
        self, goal: _Goal, outcome: Receipt | BaseException, reached: Level = "pushed"
    ) -> None:
        goal.outcome, goal.reached = outcome, reached
        goal.handle.execute()

    # ---- events that other threads pass to the executor's thread ----

    def _tell(self, goal: _Goal, stage: str, text: str) -> None:
        # the result will report a refusal too, but a crash may come before the result
        if stage == "refused":
            goal.is_refused = True
            self.get_logger().error(f"{goal}: {_one_line(text)}")
        else:
            feedback = goal.adapter.feedback(stage, text)

            def give() -> None:
                if goal.handle is None:
                    goal.feedback.append(feedback)
                elif goal.handle.is_active:
                    goal.handle.publish_feedback(feedback)

            self._in_executor(give)

    def _in_executor(self, event: Callable[[], None]) -> None:
        self._events.append(event)
        self._wake.trigger()

    def _handle_events(self) -> None:
        while self._events:
            try:
                self._events.popleft()()
            except Exception as error:  # a failure must not stop the events of other goals
                REAL.failed("events of goals", error)


def _one_line(text: str) -> str:
    return one_line(text.replace("\n", "; "))
