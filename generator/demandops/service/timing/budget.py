"""The processor time in which one demand is decided, because other demands wait meanwhile."""

from __future__ import annotations

from demandops.config.repo_settings import ROOT_FILE, Limits
from demandops.decision import Checkpoint
from demandops.demand.admission import length_faults
from demandops.errors import OverBudget
from demandops.runtime import Runtime

# The usual demand lists a dozen topics; one of this size is decided in some 10 ms.
_USUAL = Limits.model_validate({"demandItems": 200, "demandCharacters": 20_000})


def may_take_long(goal: object) -> bool:
    """Return whether a demand is so large that what was decided before it is published first."""
    return any(True for _ in length_faults(goal, _USUAL))


def within(limits: Limits, runtime: Runtime) -> Checkpoint:
    """Return a checkpoint that ends a decision once the calling thread has used its time."""
    # Only a refusal may depend on it, because another machine takes another time. Processor time,
    # because other programs on this machine must not get a demand refused.
    most = limits.decision_milliseconds
    end = runtime.processor_s() + most / 1000

    def checkpoint() -> None:
        if runtime.processor_s() > end:
            raise OverBudget(
                f"takes more than {most} ms of processor time to decide, while other demands wait; "
                "split the demand, or name nodes instead of 'place'; a platform engineer may raise "
                f"limits.decisionMilliseconds in {ROOT_FILE}"
            )

    return checkpoint
