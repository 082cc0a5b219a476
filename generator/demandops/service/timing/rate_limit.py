"""How many demands a requester may send in a minute, by the quotas of the access domains.

A generator counts only the demands that it receives itself. It counts a demand once, even if it
evaluates the demand several times.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from datetime import datetime, timedelta

from demandops.config.config import Config
from demandops.demand.demand_request import DemandRequest
from demandops.errors import Fault, fault

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
