"""The two actions that carry demands, with one adapter for each.

An adapter turns goals into plain data, and stages and outcomes into messages.
"""

from __future__ import annotations

from typing import Any

from application_manager_interfaces.action import DeploymentRequest
from builtin_interfaces.msg import Duration
from demandops.cluster.health.release_health import Level
from demandops.errors import (
    DemandOpsError,
    InvalidInput,
    NotReached,
    ShuttingDown,
    TurnedDown,
    Withdrawn,
)
from demandops.quoting import one_line
from demandops.service import Receipt
from demandops_interfaces.action import Demand

from demandops_ros.messages import ANSWER_LEVELS, demand_goal_to_data, message_to_data

# The first kind that fits counts.
_CODES: tuple[tuple[type[BaseException], str], ...] = (
    (Withdrawn, "withdrawn"),
    (TurnedDown, "turned-down"),
    (ShuttingDown, "shutting-down"),
    (DemandOpsError, "state-repo"),
    (BaseException, "fault"),
)


class DeploymentRequestAdapter:
    """The adapter for the reference's action; its results and feedback are plain text."""

    action: Any = DeploymentRequest

    def to_data(self, goal: Any) -> Any:  # noqa: ANN401 - messages are generated classes
        return message_to_data(goal)

    def name(self, goal: Any) -> str:  # noqa: ANN401
        """Return the id of a goal for the log."""
        return str(goal.id)

    def answer_level(self, goal: Any) -> Level | None:  # noqa: ANN401
        """Return the level at which to answer a goal; None if it names none."""
        return None

    def feedback(self, stage: str, text: str) -> Any:  # noqa: ANN401
        return DeploymentRequest.Feedback(message=one_line(text))

    def result(self, outcome: Receipt | BaseException, reached: Level) -> Any:  # noqa: ANN401
        """Return the result of a goal, as lines of text.

        After success, the first line is ``<outcome>: <commit>``. A line follows for each placed
        application, each warning and each listed item that was not held. After a refusal, each
        fault has a line ``<code>: <field>: <remedy>``. After another error, the line is ``<code>:
        <reason>``; for a canceled goal, only the reason.
        """
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
    if isinstance(outcome, Receipt):
        warnings = (f"warning: {one_line(warning)}" for warning in outcome.warnings)
        head = [f"{outcome.outcome}: {outcome.commit}", *map(one_line, outcome.placed)]
        return "\n".join([*head, *warnings, *_not_held(outcome)])
    if isinstance(outcome, InvalidInput):
        return outcome.text_with_codes()
    if isinstance(outcome, Withdrawn):
        return str(outcome)
    text = outcome if isinstance(outcome, DemandOpsError) else one_line(repr(outcome))
    return f"{_code(outcome)}: {text}"


def _not_held(receipt: Receipt) -> list[str]:
    return [f"listed, but not held by the requester: {one_line(item)}" for item in receipt.not_held]


def _code(outcome: Receipt | BaseException) -> str:
    if isinstance(outcome, Receipt):
        return "ok"
    if isinstance(outcome, InvalidInput):
        return outcome.faults[0].code
    if isinstance(outcome, NotReached):
        return f"not-{outcome.level}"
    return next(code for kind, code in _CODES if isinstance(outcome, kind))
