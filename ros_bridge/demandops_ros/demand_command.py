"""``demandops demand --via ros``: send demands to a node, and hold them until Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import click
from application_manager_interfaces.action import DeploymentRequest
from demandops.base.errors import DemandOpsError, InvalidInput, fault
from demandops.base.quoting import one_line
from demandops.base.settings import DEFAULT_ACTION_NAME, DEFAULT_DEMAND_ACTION_NAME
from demandops.model.demand.goals import is_demand_goal

from demandops_ros.actions import NOT_HELD, GoalSender
from demandops_ros.client import DemandClient, DemandError, HeldDemand
from demandops_ros.messages import fill_message
from demandops_ros.node_parameters import ros_name
from demandops_ros.ros_process import StopSignals

_TIMEOUT_S = 60.0
_ACTION_NAMES = (DEFAULT_DEMAND_ACTION_NAME, DEFAULT_ACTION_NAME)


@contextmanager
def sent(
    goals: Sequence[Mapping[str, Any]],
    hold: bool,
    action: str | None,
    timeout: float | None,
    tell: Callable[[str], None],
) -> Iterator[list[dict[str, Any] | DemandOpsError]]:
    """Send goals of either action; yield the answer to each, or its refusal.

    Held demands are renewed until Ctrl-C, once the block has ended, and released then. If one of
    them is refused, the others are released at once.
    """
    try:
        names = [ros_name(action or default) for default in _ACTION_NAMES]
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--action") from None
    answers: list[dict[str, Any] | DemandOpsError] = []
    with StopSignals() as signals, ExitStack() as stack:
        for goal in goals:
            client: DemandClient | GoalSender
            try:
                if is_demand_goal(goal):
                    client = DemandClient(
                        *goal.get("requesters", ()),
                        action_name=names[0],
                        timeout_s=timeout or _TIMEOUT_S,
                    )
                else:
                    client = GoalSender(
                        DeploymentRequest, names[1], "demandops_client", timeout or _TIMEOUT_S
                    )
            except Exception as error:  # rclpy raises errors of many kinds
                message = f"ROS does not start: {one_line(str(error))}"
                raise click.ClickException(message) from error
            stack.callback(client.close)
            try:
                if isinstance(client, GoalSender):
                    answers.append(_requested(client, goal, tell))
                    continue
                put = partial(client.send, goal, lambda stage, text: tell(text))
                if hold:
                    held = stack.enter_context(HeldDemand(client, str(goal.get("demand")), put))
                    assert held.answer is not None  # noqa: S101 - it was put
                    answer = held.answer
                else:
                    answer = put()
                answers.append(
                    {
                        "outcome": answer.outcome,
                        "commit": answer.commit or None,
                        "reached": answer.reached,
                        "lease": answer.lease_s or None,
                        "warnings": list(answer.warnings),
                    }
                )
            except DemandError as error:
                lines = str(error).splitlines() or [error.code]
                answers.append(InvalidInput(fault("", line, code=error.code) for line in lines))
            except (ValueError, TypeError, AssertionError, AttributeError, OverflowError) as error:
                answers.append(InvalidInput.at("", f"is not a demand: {error}"))
        yield answers
        if hold and all(isinstance(each, dict) for each in answers):
            tell("held until Ctrl-C")
            signals.wait()
    if hold:
        tell("released")


def _requested(
    sender: GoalSender, goal: Mapping[str, Any], tell: Callable[[str], None]
) -> dict[str, Any]:
    # the answer to a goal of the reference's action is text, in the form of `actions._text`
    message = fill_message(DeploymentRequest.Goal(), dict(goal))
    succeeded, result, _ = sender.send(message, lambda feedback: tell(feedback.message))
    head, *lines = result.message.splitlines() or [""]
    outcome, _, commit = head.partition(": ")
    if not succeeded:
        raise DemandError(outcome, result.message)
    answer: dict[str, Any] = {"outcome": outcome, "commit": commit or None}
    for line in lines:
        said, _, text = line.partition(": ")
        kind = {"warning": "warnings", NOT_HELD: "not_held"}.get(said)
        answer.setdefault(kind or "effects", []).append(text if kind else line)
    return answer
