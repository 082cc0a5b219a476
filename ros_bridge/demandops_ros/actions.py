"""The two actions that carry demands: adapters for their messages, and their servers."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from functools import partial
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from application_manager_interfaces.action import DeploymentRequest
from builtin_interfaces.msg import Duration
from demandops.base.errors import DemandOpsError, InvalidInput, Withdrawn
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL
from demandops.cluster.health import Level
from demandops.serve.journal import Receipt
from demandops_interfaces.action import Demand
from rclpy.action import ActionClient, ActionServer
from rclpy.action.client import ClientGoalHandle
from rclpy.node import Node
from rclpy.qos import QoSProfile
from unique_identifier_msgs.msg import UUID

from demandops_ros.messages import ANSWER_LEVELS, demand_goal_to_data, message_to_data
from demandops_ros.ros_process import ExecutorThread

# ---- an adapter for each action ----
#
# An adapter turns goals into plain data, and stages and outcomes into messages.

# The request id of all claims by DeploymentRequests if the node ignores the ids of goals. A claim's
# file and its commit say so by this text.
IGNORED_ID = "ignored-id"


class DeploymentRequestAdapter:
    # of the reference's action, whose results and feedback are plain text
    action: Any = DeploymentRequest

    def __init__(self, *, ignores_ids: bool = False) -> None:
        self._ignores_ids = ignores_ids

    def to_data(self, goal: Any) -> Any:  # noqa: ANN401
        data = message_to_data(goal)
        return {**data, "id": IGNORED_ID} if self._ignores_ids else data

    def name(self, goal: Any) -> str:  # noqa: ANN401
        return str(goal.id)

    def answer_level(self, goal: Any) -> Level | None:  # noqa: ANN401
        return None  # it names none

    def feedback(self, stage: str, text: str) -> Any:  # noqa: ANN401
        return DeploymentRequest.Feedback(message=one_line(text))

    def result(self, outcome: Receipt | BaseException, reached: Level) -> Any:  # noqa: ANN401
        return DeploymentRequest.Result(message=_text(outcome))


class DemandAdapter(DeploymentRequestAdapter):
    action = Demand

    def to_data(self, goal: Any) -> Any:  # noqa: ANN401
        return demand_goal_to_data(goal)

    def name(self, goal: Any) -> str:  # noqa: ANN401
        return str(goal.demand_id)

    def answer_level(self, goal: Any) -> Level | None:  # noqa: ANN401
        return ANSWER_LEVELS[goal.answer] if goal.answer < len(ANSWER_LEVELS) else None

    def feedback(self, stage: str, text: str) -> Any:  # noqa: ANN401
        return Demand.Feedback(stage=stage, message=one_line(text))

    def result(self, outcome: Receipt | BaseException, reached: Level) -> Any:  # noqa: ANN401
        result = Demand.Result(code=_code(outcome), message=_text(outcome))
        if isinstance(outcome, Receipt):
            result.outcome, result.commit, result.reached = outcome.outcome, outcome.commit, reached
            result.lease = Duration(sec=outcome.lease_s or 0)
            result.warnings = [*map(one_line, outcome.warnings), *_not_held(outcome)]
        return result


def _text(outcome: Receipt | BaseException) -> str:
    # After success, the first line is ``<outcome>: <commit>``. A line follows for each placed
    # application, each effect on releases ("reconfigures of-edge-fusion"), each warning and each
    # listed item that was not held. After a refusal, each fault
    # has a line ``<code>: <field>: <remedy>``. After another error, the line is ``<code>:
    # <reason>``; for a canceled goal, only the reason.
    if isinstance(outcome, Receipt):
        warnings = (f"warning: {one_line(warning)}" for warning in outcome.warnings)
        told = map(one_line, (*outcome.placed, *outcome.effects))
        head = [f"{outcome.outcome}: {outcome.commit}", *told]
        return "\n".join([*head, *warnings, *_not_held(outcome)])
    if isinstance(outcome, InvalidInput):
        return outcome.text_with_codes()
    if isinstance(outcome, Withdrawn):
        return str(outcome)
    text = outcome if isinstance(outcome, DemandOpsError) else one_line(repr(outcome))
    return f"{_code(outcome)}: {text}"


NOT_HELD = "listed, but not held by the requester"


def _not_held(receipt: Receipt) -> list[str]:
    return [f"{NOT_HELD}: {one_line(item)}" for item in receipt.not_held]


def _code(outcome: Receipt | BaseException) -> str:
    if isinstance(outcome, Receipt):
        return "ok"
    return outcome.code if isinstance(outcome, DemandOpsError) else "fault"


# ---- endpoints: a client that sends goals, a server, and a search for other servers ----

# The length of the queues for goals, results, cancels and feedback. ROS's default of 10 is too
# small for a burst, because a client's queue also gets the answers to other clients.
DEEP_QOS = QoSProfile(depth=2000)
DEEP_SERVICES = {
    f"{service}_service_qos_profile": DEEP_QOS for service in ("goal", "result", "cancel")
}

# How long to wait for the node's response to a goal before the goal is sent again. A node normally
# responds within milliseconds.
_UNHEARD_S = 5.0

_GOAL_KEPT_S = 10  # how long ROS keeps a goal that has ended
_RESULT_S = 900  # how long LastingResults keeps a result that ROS has forgotten
# How many results it keeps; if there are more, it forgets the oldest ones earlier.
_MOST_RESULTS = 2_000


class DemandError(Exception):
    """Raised when a demand fails or gets no answer in time.

    ``code`` tells programs the reason, such as ``unknown-node``. After ``timeout``, nobody knows
    whether the demand is booked.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def ask_the_node(client: ActionClient) -> Any:  # noqa: ANN401 - a future of rclpy
    # A harmless request, to cancel a goal that does not exist. Its answer shows that the node has
    # discovered the client.
    nobodys = UUID(uuid=list(bytes.fromhex(REAL.fresh_id().replace("-", ""))))
    return ClientGoalHandle(client, nobodys, None).cancel_goal_async()


class GoalSender:
    """Sends goals of one action and waits for the answers; many threads may send at once."""

    def __init__(
        self,
        action: Any,  # noqa: ANN401 - a generated class
        action_name: str,
        node_name: str,
        timeout_s: float,
        domain_id: int | None = None,
    ) -> None:
        self.timeout_s = timeout_s
        self._action_name = action_name
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain_id)
        # a launch file renames all nodes of a process, unless a node has a rule of its own
        own_name = ["--ros-args", "-r", f"__node:={node_name}"]
        self._node = rclpy.create_node(node_name, context=self._context, cli_args=own_name)
        self._client = ActionClient(
            self._node,
            action,
            action_name,
            **DEEP_SERVICES,
            feedback_sub_qos_profile=DEEP_QOS,
        )
        self._thread = ExecutorThread(self._node, "client")
        self._is_discovered = False

    def close(self) -> None:
        self._thread.close()
        self._node.destroy_node()
        self._context.try_shutdown()

    def send(
        self,
        goal: Any,  # noqa: ANN401 - a generated class
        on_feedback: Callable[[Any], None] = lambda feedback: None,
    ) -> tuple[bool, Any, bool]:
        """Send a goal and wait for its result, for ``timeout_s`` at most.

        Return whether the goal succeeded, its result, and whether an earlier attempt to send it got
        no response. The node may have carried out that attempt too. Raises DemandError with the
        code ``no-server``, ``rejected`` or ``timeout``, and ValueError if a text is not Unicode.
        """
        deadline = REAL.monotonic() + self.timeout_s
        if not self._client.wait_for_server(timeout_sec=self.timeout_s):
            raise DemandError(
                "no-server",
                f"no node in this ROS domain serves {self._action_name}; start one with demandops "
                "serve, or correct the action's name or ROS_DOMAIN_ID",
            )
        # A client discovers the node before the node discovers the client. Until then, the node's
        # answers to the client are lost.
        while not self._is_discovered and REAL.monotonic() < deadline:
            try:
                self._await(ask_the_node(self._client), REAL.monotonic() + 0.2)
            except DemandError:
                continue
            self._is_discovered = True

        # The goal is sent in the thread that also receives: rclpy 9.1 registers two futures for a
        # goal, one after the other, and returns the second. If another thread sent the goal, a
        # response could arrive between the two, and would resolve only the first, for which nobody
        # waits.
        def send(sent: Future[Any]) -> None:
            try:
                sent.set_result(
                    self._client.send_goal_async(
                        goal, feedback_callback=lambda message: on_feedback(message.feedback)
                    )
                )
            except Exception as error:  # the caller must get it, not the executor
                sent.set_exception(error)

        # A response is lost also if a new node replaced the old one and has not yet discovered this
        # client. Sending the goal again is harmless: a demand that is put twice counts once, and a
        # second release finds nothing to release.
        lost = False
        while True:
            try:
                sent: Future[Any] = Future()
                self._thread.call(partial(send, sent))
                response = self._await(sent, deadline)
                handle = self._await(response, min(deadline, REAL.monotonic() + _UNHEARD_S))
                break
            except DemandError:
                if REAL.monotonic() >= deadline:
                    raise
                lost = True
        if not handle.accepted:
            message = "the node did not accept the demand (its log says why); send it again later"
            raise DemandError("rejected", message)
        answer = self._await(handle.get_result_async(), deadline)
        return answer.status == GoalStatus.STATUS_SUCCEEDED, answer.result, lost

    def _await(self, future: Any, deadline: float) -> Any:  # noqa: ANN401
        done = REAL.event()
        future.add_done_callback(lambda _: done.set())
        if not done.wait(max(0.0, deadline - REAL.monotonic())):
            text = f"no answer on {self._action_name} within {self.timeout_s:g} s"
            raise DemandError("timeout", text)
        return future.result()


class LastingResults(ActionServer):  # type: ignore[misc]
    # It keeps results longer than goals, for clients that ask late. With a version of rclpy that
    # does not call the overridden methods, results are kept for ten seconds.
    #
    # Whenever a goal changes, ROS publishes the status of all goals that it keeps. So each kept
    # goal slows down every other goal, in the server and in every client. Therefore ROS keeps a
    # goal only for its default of ten seconds, and this class keeps the goal's result for longer.

    def __init__(self, *args: Any, **options: Any) -> None:  # noqa: ANN401
        self._lasting: OrderedDict[bytes, tuple[float, Any]] = OrderedDict()
        super().__init__(*args, result_timeout=_GOAL_KEPT_S, **options)

    async def _execute_expire_goals(self, expired_goals: Any) -> None:  # noqa: ANN401
        now = REAL.monotonic()
        for goal in expired_goals:
            id = bytes(goal.goal_id.uuid)
            self._lasting[id] = (now, self._result_futures[id])
        while self._lasting:
            oldest, _ = next(iter(self._lasting.values()))
            if now - oldest <= _RESULT_S and len(self._lasting) <= _MOST_RESULTS:
                break
            self._lasting.popitem(last=False)
        await super()._execute_expire_goals(expired_goals)

    async def _execute_get_result_request(self, request: Any) -> None:  # noqa: ANN401
        header, asked = request
        id = bytes(asked.goal_id.uuid)
        if id in self._lasting and id not in self._goal_handles:
            self._send_result_response(header, self._lasting[id][1])
        else:
            await super()._execute_get_result_request(request)


class OtherServers:
    def __init__(self, node: Node, actions: Iterable[str]) -> None:
        self._node = node
        self._own = node.get_fully_qualified_name()
        self._found = {node.resolve_service_name(action): list[str]() for action in actions}

    def find(self) -> dict[str, list[str]]:
        # by action; changes are logged, but not of a node that comes and goes between two calls
        for action, others in self._found.items():
            publishers = self._node.get_publishers_info_by_topic(f"{action}/_action/status")
            now = sorted(f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in publishers)
            if self._own in now:
                now.remove(self._own)  # one entry only: another node may have this name
            if now and now != others:
                self._node.get_logger().warning(
                    f"{', '.join(now)} serves {action} too, so a client may get its answer "
                    "from another node, or no answer; give each node an action name of its own"
                )
            elif others and not now:
                self._node.get_logger().info(f"no other node serves {action} any more")
            self._found[action] = now
        return self._found
