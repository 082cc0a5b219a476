"""Leases: how long a claim stays booked without a renewal.

The recorded end may lag behind the last renewal by ``slack``, so that only some renewals make a
commit. A renewal within the slack changes nothing, and a lease ends only after the recorded end and
the slack have passed. So no generator, not even a restarted one, releases a claim early,
but a release may be late by the slack.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone

LONGEST_S = 366 * 24 * 3600

# The end of a lease that has not started. Its claim awaits approval, or a person approved it and
# the generator has not started the lease yet.
UNSTARTED = datetime(9000, 1, 1, tzinfo=timezone.utc)


@dataclass(frozen=True, slots=True)
class Term:
    """The requested lease and its slack, both in seconds."""

    seconds: int
    slack: int = 0
    # the lease starts when a person approves the request, not when the request is received
    on_approval: bool = False

    def lease_from(self, now: datetime) -> Lease:
        if self.on_approval:
            return Lease(self.seconds, self.slack, UNSTARTED)
        return Lease(self.seconds, self.slack, now + timedelta(seconds=self.seconds))


@dataclass(frozen=True, slots=True)
class Lease:
    seconds: int
    slack: int
    until: datetime

    @property
    def has_started(self) -> bool:
        return self.until < UNSTARTED

    def started(self, now: datetime, before: Lease | None = None) -> Lease:
        """Return the lease of a claim that a person approves at ``now``."""
        term = Term(self.seconds, self.slack)
        # the approval of a changed demand renews its lease, which never ends earlier than before
        return before.renewed(term, now) if before else term.lease_from(now)

    @property
    def expires_at(self) -> datetime:
        """The time after which the claim may be released."""
        return self.until + timedelta(seconds=self.slack)

    def has_ended(self, now: datetime) -> bool:
        return self.expires_at < now

    def renewed(self, term: Term, now: datetime) -> Lease:
        wanted = term.lease_from(now)
        same_term = (self.seconds, self.slack) == (term.seconds, term.slack)
        # a thousand vehicles renew every few minutes, and not each renewal may make a commit
        if same_term and wanted.until <= self.expires_at:
            return self
        # the end never moves to an earlier time, because the clock may have been set back
        return replace(wanted, until=max(wanted.until, self.until))


def renewed(current: Lease | None, term: Term | None, now: datetime) -> Lease | None:
    if term is None:
        return None
    return current.renewed(term, now) if current else term.lease_from(now)
