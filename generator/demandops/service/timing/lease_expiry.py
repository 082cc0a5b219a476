"""Which leases have ended, by a clock that a person may set.

A clock that is set back only delays a release. A clock that jumps forward would end leases that
were renewed in time, so after a jump every lease gets its full term again. The sleep of a machine
looks like a jump and has the same effect.
"""

from __future__ import annotations

import logging
from datetime import datetime, timedelta

from demandops.demand.claim import Claim
from demandops.demand.demand_request import Expire
from demandops.ledger.ledger import Ledger
from demandops.runtime import Runtime
from demandops.service.ticket import Ticket

log = logging.getLogger("demandops")

_JUMP = timedelta(seconds=30)
_SHORTEST_S = 1.0
LONGEST_WAIT_S = 60.0
"""The longest time between two checks of the leases, because the clock may be set meanwhile."""


class LeaseClock:
    """Decides which leases have ended, and when to check again."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._last = (runtime.now(), runtime.monotonic())
        self._jumped_at: datetime | None = None

    def ended_claims(self, ledger: Ledger) -> tuple[datetime, list[Claim]]:
        """Return the time and the claims whose lease has ended, the first to end first.

        The ended claims of one demand are released together: if one of them is granted more time,
        none is returned.
        """
        now = self._read_clocks()
        ended = ledger.ended_claims(now)
        granted = {claim.demand for claim in ended if not self._has_ended(claim, now)}
        return now, [claim for claim in ended if claim.demand not in granted]

    def seconds_until_due(self, ledger: Ledger, longest: float) -> float:
        """Return the seconds until the next check: at least one, at most ``longest``.

        Never zero, because an ended lease stays in the ledger if its release failed or if it was
        granted more time.
        """
        end = ledger.next_lease_end()
        if end is None:
            return longest
        return min(max((end - self._read_clocks()).total_seconds() + 0.01, _SHORTEST_S), longest)

    def _read_clocks(self) -> datetime:
        wall, steady = self._runtime.now(), self._runtime.monotonic()
        expected = self._last[0] + timedelta(seconds=steady - self._last[1])
        if wall - expected > _JUMP:
            jump = (wall - expected).total_seconds()
            log.warning("the clock went forward by %.0f s; every lease gets its full term", jump)
            self._jumped_at = wall
        self._last = (wall, steady)
        return wall

    def _has_ended(self, claim: Claim, now: datetime) -> bool:
        if claim.lease is None:
            return False
        if self._jumped_at is None:
            return True
        term = timedelta(seconds=claim.lease.seconds + claim.lease.slack)
        return now > self._jumped_at + term


class LeaseExpiry:
    """Makes the demands that release claims whose lease has ended."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._clock = LeaseClock(runtime)
        self._tried: dict[str, datetime] = {}

    def seconds_until_due(self, ledger: Ledger, longest: float) -> float:
        """Return the seconds until the next check."""
        return self._clock.seconds_until_due(ledger, longest)

    def tickets(self, ledger: Ledger) -> list[Ticket]:
        """Return a ticket for each demand whose lease has ended.

        A demand that could not be released, because its files do not render, is tried again later.
        """
        now, claims = self._clock.ended_claims(ledger)
        since = now - timedelta(seconds=LONGEST_WAIT_S)
        ended = dict.fromkeys(claim.demand for claim in claims)
        # forget what was released or renewed meanwhile
        self._tried = {d: at for d, at in self._tried.items() if at > since and d in ended}
        demands = [demand for demand in ended if demand not in self._tried]
        self._tried |= dict.fromkeys(demands, now)
        requests = (Expire(id=demand, demand=demand) for demand in demands)
        return [
            Ticket(self._runtime.fresh_id(), request, now, lambda stage, text: None)
            for request in requests
        ]
