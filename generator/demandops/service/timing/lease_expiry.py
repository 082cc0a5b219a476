"""Which leases have run out, by a clock that may be set.

A clock set back only delays a release. One set forward would end leases that were renewed in
time by the old clock, so such a step grants every lease its full term again. A machine that was
asleep looks the same and is treated alike.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Callable
from datetime import datetime, timedelta, timezone

from demandops.demand.claim import Claim
from demandops.demand.demand_request import DemandRequest, Operation
from demandops.ledger.apply import Ledger
from demandops.service.ticket import Ticket

log = logging.getLogger("demandops")

_STEP = timedelta(seconds=30)
_SHORTEST_S = 1.0
LONGEST_WAIT_S = 60.0
"""Between two looks at the leases: a clock may be set meanwhile."""


def _wall() -> datetime:
    return datetime.now(timezone.utc)


class LeaseClock:
    """Tells which claims are to be released, and how long nothing will be."""

    def __init__(
        self, wall: Callable[[], datetime] = _wall, steady: Callable[[], float] = time.monotonic
    ) -> None:
        self._wall, self._steady = wall, steady
        self._last = (wall(), steady())
        self._stepped: datetime | None = None

    def ended_claims(self, ledger: Ledger) -> tuple[datetime, list[Claim]]:
        """Return the time and the claims whose lease is over, the first to end first.

        What of a demand has ended goes together, so none of it while some is granted more time.
        """
        now = self._look()
        ended = ledger.ended(now)
        granted = {claim.demand for claim in ended if not self._is_over(claim, now)}
        return now, [claim for claim in ended if claim.demand not in granted]

    def seconds_until_due(self, ledger: Ledger, longest: float) -> float:
        """Return the seconds until the next look is due: ``longest`` at most, one at least.

        Not at once, for what is over and still there could not be released or is granted more.
        """
        end = ledger.next_end()
        if end is None:
            return longest
        return min(max((end - self._look()).total_seconds() + 0.01, _SHORTEST_S), longest)

    def _look(self) -> datetime:
        wall, steady = self._wall(), self._steady()
        expected = self._last[0] + timedelta(seconds=steady - self._last[1])
        if wall - expected > _STEP:
            step = (wall - expected).total_seconds()
            log.warning("the clock went forward by %.0f s; every lease gets its full term", step)
            self._stepped = wall
        self._last = (wall, steady)
        return wall

    def _is_over(self, claim: Claim, now: datetime) -> bool:
        if claim.lease is None:
            return False
        if self._stepped is None:
            return True
        term = timedelta(seconds=claim.lease.seconds + claim.lease.slack)
        return now > self._stepped + term


class LeaseExpiry:
    """Hands in the releases of what ran out; nobody waits for their receipts."""

    def __init__(self) -> None:
        self._clock = LeaseClock()
        self._tried: dict[str, datetime] = {}

    def seconds_until_due(self, ledger: Ledger, longest: float) -> float:
        """Return the seconds until the next look is due."""
        return self._clock.seconds_until_due(ledger, longest)

    def tickets(self, ledger: Ledger) -> list[Ticket]:
        """Return a ticket for each demand whose lease ran out.

        One that cannot be released (its files do not render) is tried again after a while.
        """
        now, claims = self._clock.ended_claims(ledger)
        since = now - timedelta(seconds=LONGEST_WAIT_S)
        over = dict.fromkeys(claim.demand for claim in claims)
        tried = self._tried  # what is over no more was released or renewed
        self._tried = {d: when for d, when in tried.items() if when > since and d in over}
        demands = [demand for demand in over if demand not in self._tried]
        self._tried |= dict.fromkeys(demands, now)
        requests = [
            DemandRequest(id=demand, operation=Operation.EXPIRE, demand=demand)
            for demand in demands
        ]
        return [
            Ticket(str(uuid.uuid4()), request, now, lambda stage, text: None)
            for request in requests
        ]
