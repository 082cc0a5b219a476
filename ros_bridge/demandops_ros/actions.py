"""The two actions that carry demands, with one adapter for each.

An adapter turns goals into plain data, and stages and outcomes into messages.
"""

from __future__ import annotations

from typing import Any, Protocol

from application_manager_interfaces.action import DeploymentRequest
from builtin_interfaces.msg import Duration
from demandops.cluster.health.release_health import Level
from demandops.decision import refusal_text
from demandops.errors import (
    DemandOpsError,
    InvalidInput,
    NotReached,
    QueueFull,
    ShuttingDown,
    TurnedDown,
    Withdrawn,
)
from demandops.service import Receipt
from demandops_interfaces.action import Demand

from demandops_ros.messages import demand_goal_to_data, message_to_data

ANSWER_LEVELS: tuple[Level, ...] = ("pushed", "reconciled", "healthy")


class ActionAdapter(Protocol):
    """The part of the node that is specific to one action."""

    action: Any

    def to_data(self, goal: Any) -> Any:  # noqa: ANN401 - messages are generated classes
        """Return a goal as plain data."""

    def name(self, goal: Any) -> str:  # noqa: ANN401
        """Return the name of a goal for the log."""

    def answer_level(self, goal: Any) -> Level | None:  # noqa: ANN401
        """Return the level at which to answer a goal, or None if the goal names none."""

    def feedback(self, stage: str, text: str) -> Any:  # noqa: ANN401
        """Return the feedback for a stage."""

    def result(self, outcome: Receipt | BaseException, reached: Level) -> Any:  # noqa: ANN401
        """Return the result for the outcome of a goal and the level that it reached."""


class DeploymentRequestAdapter:
    """The reference's action, whose results and feedback are plain text."""

    action = DeploymentRequest

    def to_data(self, goal: Any) -> Any:  # noqa: ANN401
        """Return a goal as plain data."""
        return message_to_data(goal)

    def name(self, goal: Any) -> str:  # noqa: ANN401
        """Return the request's id."""
        return str(goal.id)

    def answer_level(self, goal: Any) -> Level | None:  # noqa: ANN401
        """Return None, because the message has no field for the level."""
        return None

    def feedback(self, stage: str, text: str) -> Any:  # noqa: ANN401
        """Return the stage as text."""
        return DeploymentRequest.Feedback(message=text)

    def result(self, outcome: Receipt | BaseException, reached: Level) -> Any:  # noqa: ANN401
        """Return ``<outcome>: <commit>``, or ``<code>: <field>: <remedy>``."""
        return DeploymentRequest.Result(message=_text(outcome))


class DemandAdapter:
    """DemandOps' own action."""

    action = Demand

    def to_data(self, goal: Any) -> Any:  # noqa: ANN401
        """Return a goal as plain data."""
        return demand_goal_to_data(goal)

    def name(self, goal: Any) -> str:  # noqa: ANN401
        """Return the demand's id."""
        return str(goal.demand_id)

    def answer_level(self, goal: Any) -> Level | None:  # noqa: ANN401
        """Return the level that the goal names."""
        return ANSWER_LEVELS[goal.answer] if goal.answer < len(ANSWER_LEVELS) else None

    def feedback(self, stage: str, text: str) -> Any:  # noqa: ANN401
        """Return stage and text."""
        return Demand.Feedback(stage=stage, message=text)

    def result(self, outcome: Receipt | BaseException, reached: Level) -> Any:  # noqa: ANN401
        """Return code and text, and the receipt's fields if there is a receipt."""
        result = Demand.Result(code=_code(outcome), message=_text(outcome))
        if isinstance(outcome, Receipt):
            result.outcome = outcome.outcome
            result.commit = outcome.commit
            result.lease = Duration(sec=outcome.lease_s or 0)
            result.warnings = [
                *outcome.warnings,
                *(f"not held: {item}" for item in outcome.not_held),
            ]
            result.reached = reached
        return result


def _text(outcome: Receipt | BaseException) -> str:
    if isinstance(outcome, Receipt):
        lines = [f"{outcome.outcome}: {outcome.commit}"]
        lines += [f"warning: {warning}" for warning in outcome.warnings]
        lines += [f"not held: {item}" for item in outcome.not_held]
        return "\n".join(lines)
    if isinstance(outcome, InvalidInput):
        return refusal_text(outcome)
    if isinstance(outcome, Withdrawn):
        return str(outcome)
    return f"{_code(outcome)}: {outcome if isinstance(outcome, DemandOpsError) else repr(outcome)}"


def _code(outcome: Receipt | BaseException) -> str:
    if isinstance(outcome, Receipt):
        return "ok"
    if isinstance(outcome, InvalidInput):
        return outcome.faults[0].code
    for kind, code in (
        (Withdrawn, "withdrawn"),
        (TurnedDown, "turned-down"),
        (NotReached, f"not-{getattr(outcome, 'level', '')}"),
        (ShuttingDown, "shutting-down"),
        (QueueFull, "queue-full"),
        (DemandOpsError, "state-repo"),
    ):
        if isinstance(outcome, kind):
            return code
    return "fault"
