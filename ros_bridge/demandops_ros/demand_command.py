"""``demandops demand --via ros``: send demands to a node, and hold them until Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import click
from demandops.base.errors import DemandOpsError, InvalidInput, fault
from demandops.base.quoting import one_line
from demandops.base.settings import DEFAULT_DEMAND_ACTION_NAME

from demandops_ros.client import DemandClient, DemandError, HeldDemand
from demandops_ros.node_parameters import ros_name
from demandops_ros.ros_process import StopSignals

_TIMEOUT_S = 60.0


@contextmanager
def sent(
    goals: Sequence[Mapping[str, Any]],
    hold: bool,
    action: str | None,
    timeout: float | None,
    tell: Callable[[str], None],
) -> Iterator[list[dict[str, Any] | DemandOpsError]]:
    """Send documents of the kind ``Demand``; yield the answer to each, or its refusal.

    Held demands are renewed until Ctrl-C, once the block has ended, and released then. If one of
    them is refused, the others are released at once.
    """
    try:
        name = ros_name(action or DEFAULT_DEMAND_ACTION_NAME)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--action") from None
    answers: list[dict[str, Any] | DemandOpsError] = []
    with StopSignals() as signals, ExitStack() as stack:
        for goal in goals:
            try:
                client = DemandClient(
                    *goal.get("requesters", ()), action_name=name, timeout_s=timeout or _TIMEOUT_S
                )
            except Exception as error:  # rclpy raises errors of many kinds
                message = f"ROS does not start: {one_line(str(error))}"
                raise click.ClickException(message) from error
            stack.enter_context(client)
            put = partial(client.send, goal, lambda stage, text: tell(text))
            try:
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
