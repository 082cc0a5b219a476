"""The processor time in which one demand is decided, because other demands wait meanwhile."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from datetime import datetime, timedelta

from demandops.base.errors import Fault, OverBudget, fault
from demandops.base.runtime import Runtime
from demandops.decide.admission.admission import length_faults
from demandops.decide.admission.admitted_request import Checkpoint
from demandops.model.config.config import Config
from demandops.model.config.repo_settings import ROOT_FILE, Limits
from demandops.model.demand.demand_request import DemandRequest

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


# ---- how many demands a requester may send in a minute, by the quotas of the access domains ----
#
# A generator counts only the demands that it receives itself. It counts a demand once, even if it
# evaluates the demand several times.

_WINDOW = timedelta(minutes=1)


class RateLimit:
    def __init__(self) -> None:
        self._seen: dict[tuple[str, str], deque[tuple[datetime, str]]] = {}

    def faults(
        self, request: DemandRequest, config: Config, operation: str, received: datetime
    ) -> Iterator[Fault]:
        """Count a demand, and yield a fault for each quota that a requester exceeds with it.

        A demand counts even if it is refused afterwards. A request that adds no claims is not
        limited.
        """
        if not request.adds_claims:
            return
        homes = (config.domain_of.get(demanded.held.home) for demanded in request.demanded)
        domains = {domain.name: domain for domain in homes if domain is not None}
        for domain in domains.values():
            most = domain.quotas.demands_per_minute
            for requester in request.requesters() if most else ():
                if self._count((domain.name, requester), operation, received) > (most or 0):
                    message = (
                        f"'{requester}' sent more than {most} demands in a minute, the limit in "
                        f"quotas.demandsPerMinute of access domain '{domain.name}'; send the "
                        "demand again later"
                    )
                    yield fault("", message, code="quota")

    def _count(self, key: tuple[str, str], operation: str, received: datetime) -> int:
        """Count a demand, and return its number among those of the last minute."""
        # forget requesters that sent nothing for a minute, because vehicles come and go
        while self._seen:
            idlest = next(iter(self._seen))
            times = self._seen[idlest]
            if times and abs(received - times[-1][0]) <= _WINDOW:
                break
            del self._seen[idlest]
        seen = self._seen.pop(key, None) or deque()
        self._seen[key] = seen  # at the end, so that the requester that is idle longest is first
        while seen and abs(received - seen[0][0]) > _WINDOW:  # the clock may have been set back
            seen.popleft()
        # a demand that is evaluated again keeps its number
        operations = [earlier for _, earlier in seen]
        if operation in operations:
            return operations.index(operation) + 1
        seen.append((received, operation))
        return len(seen)
