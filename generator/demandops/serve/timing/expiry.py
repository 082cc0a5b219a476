"""Ends leases and overrides when their time comes.

A person may set the clock. A clock that is set back only delays the end of a lease. A clock that
jumps forward would end leases that were renewed in time, so after a jump every lease gets its
full term again. The sleep of a machine looks like a jump and has the same effect. While no
generator ran, nobody could renew a lease, so after a start no lease ends before its term, or ten
minutes of a longer one, have passed. Overrides get no more time after a jump or a start.
"""

from __future__ import annotations

import logging
from concurrent.futures import Future
from datetime import datetime, timedelta, timezone

from demandops.base.errors import InvalidInput
from demandops.base.quoting import quoted
from demandops.base.runtime import Runtime
from demandops.decide.placement.relocation import expired_overrides
from demandops.model.demand.demand import Demand
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import Ledger, World
from demandops.repo.write.commit_batch import CommitBatch
from demandops.serve.queue import Receipt, Ticket

log = logging.getLogger("demandops")

# By how much the clock may gain on the monotonic clock before leases get their full term again.
_JUMP = timedelta(seconds=30)
# The longest grace after a start. A client that is alive and failed to renew tries again within it;
# with more, a generator that is restarted each day would keep the day-long leases of vehicles that
# are gone for ever.
_LONGEST_GRACE_S = 600.0
# The ledger keeps a lease that has ended if its release failed, or if it got more time after a jump
# of the clock or a start. Without this minimum, the worker would then never wait.
_SHORTEST_S = 1.0
# The longest time between two checks of the leases; short, because a person may set the clock.
LONGEST_WAIT_S = 60.0
# The pause after a failed try to end a lease or an override.
RETRY = timedelta(seconds=LONGEST_WAIT_S)


class LeaseExpiry:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._started = runtime.monotonic()
        self._last = (runtime.now(), self._started)
        self._jumped_at: datetime | None = None
        self._tried: dict[str, datetime] = {}
        self._first: object = None
        self._next_end: datetime | None = None

    def tickets(self, ledger: Ledger) -> list[Ticket]:
        # The tickets are correct only now: later, a requester may renew a lease, or a person may
        # set the clock. If one does not release its claims, the next comes at least a minute later.
        now, claims = self.ended_claims(ledger)
        ended = dict.fromkeys(claim.demand for claim in claims)
        # forget demands that were released or renewed meanwhile
        self._tried = {d: at for d, at in self._tried.items() if at > now - RETRY and d in ended}
        return [self._ticket(demand, now) for demand in ended if demand not in self._tried]

    def _ticket(self, demand: str, now: datetime) -> Ticket:
        ticket = Ticket(
            self._runtime.fresh_id(), Demand("expire", demand, demand=demand, is_complete=True), now
        )

        def tell(future: Future[Receipt]) -> None:
            self._tried[demand] = now
            error = future.exception()
            if isinstance(error, InvalidInput):  # no client gets this error, so report it here
                self._runtime.failed(f"end of the lease of {quoted(demand)}", error)
            elif error is None:
                outcome = future.result().outcome
                log.info("the lease of %s has ended: %s", quoted(demand), outcome)

        ticket.future.add_done_callback(tell)
        return ticket

    def ended_claims(self, ledger: Ledger) -> tuple[datetime, list[Claim]]:
        """Return the current time, and the claims whose lease has ended, earliest end first."""
        now = self._read_clocks()
        ended = ledger.ended_claims(now)
        # a demand's claims are released together, so if one gets more time, none is released
        granted = {claim.demand for claim in ended if not self._has_ended(claim, now)}
        return now, [claim for claim in ended if claim.demand not in granted]

    def seconds_until_due(self, ledger: Ledger, longest: float) -> float:
        first = ledger.first_to_end()
        if first is not self._first:  # a search is slow if many leases end at one time
            self._first, self._next_end = first, ledger.next_lease_end()
        end = self._next_end
        return longest if end is None else _seconds_until(end, self._read_clocks(), longest)

    def _read_clocks(self) -> datetime:
        wall, steady = self._runtime.now(), self._runtime.monotonic()
        expected = self._last[0] + timedelta(seconds=steady - self._last[1])
        if wall - expected > _JUMP:
            jump = (wall - expected).total_seconds()
            log.warning("the clock jumped forward by %.0f s, so leases get their full term", jump)
            self._jumped_at = wall
        self._last = (wall, steady)
        return wall

    def _has_ended(self, claim: Claim, now: datetime) -> bool:
        lease = claim.lease
        if lease is None:
            return False
        if self._runtime.monotonic() - self._started < min(lease.seconds, _LONGEST_GRACE_S):
            return False
        term = timedelta(seconds=lease.seconds + lease.slack)
        return self._jumped_at is None or now > self._jumped_at + term


class OverrideExpiry:
    def __init__(self) -> None:
        # By name and end: an override whose end a person changes is tried again at once.
        self._retry_at: dict[tuple[str, datetime | None], datetime] = {}
        # Before this time no end counts as due, but each batch of demands still commits the ends.
        self.not_before = datetime.min.replace(tzinfo=timezone.utc)

    def end_due(self, commits: CommitBatch, now: datetime) -> None:
        for override in expired_overrides(commits.head.state, now):
            if self._retry_at.get((override.name, override.end), now) > now:
                continue
            try:
                commits.end_override(override, now)
                log.info("%s ended as planned at %s", override.path, override.expires)
            except InvalidInput as error:
                self._retry_at[override.name, override.end] = now + RETRY
                for problem in error.faults:
                    log.error("%s cannot be ended: %s; trying again later", override.path, problem)

    def is_due(self, world: World, now: datetime) -> bool:
        return any(time <= now for time in self._due_times(world))

    def seconds_until_due(self, world: World, now: datetime, longest: float) -> float:
        times = self._due_times(world)
        return _seconds_until(min(times), now, longest) if times else longest

    def _due_times(self, world: World) -> list[datetime]:
        return [
            max(self._retry_at.get((override.name, override.end), override.end), self.not_before)
            for override in world.overrides
            if override.end
        ]


def _seconds_until(time: datetime, now: datetime, longest: float) -> float:
    return min(max((time - now).total_seconds() + 0.01, _SHORTEST_S), longest)
