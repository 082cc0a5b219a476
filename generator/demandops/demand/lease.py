"""Leases: how long a claim holds without being asked for again.

The recorded end may lag behind the last renewal by ``slack``, so that not every renewal makes a
commit. Nothing else is remembered: a renewal that the record covers within the slack is dropped,
and nothing is released before end and slack have passed. So no claim is ever released early, by
this generator, another one or one that was restarted; it may go late by the slack.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone

LONGEST_S = 366 * 24 * 3600

UNSTARTED = datetime(9000, 1, 1, tzinfo=timezone.utc)
"""The end of a lease that has not begun: its claim is proposed, and counts from the approval."""


@dataclass(frozen=True, slots=True)
class Term:
    """How long a claim is to hold from when it is asked for; both in seconds.

    ``on_approval``: from when it is approved.
    """

    seconds: int
    slack: int = 0
    on_approval: bool = False

    def lease_from(self, now: datetime) -> Lease:
        """Return the lease of a claim that is asked for at ``now``."""
        if self.on_approval:
            return Lease(self.seconds, self.slack, UNSTARTED)
        return Lease(self.seconds, self.slack, now + timedelta(seconds=self.seconds))


@dataclass(frozen=True, slots=True)
class Lease:
    """A running lease: its term and its recorded end, in UTC."""

    seconds: int
    slack: int
    until: datetime

    @property
    def has_started(self) -> bool:
        """Tell whether its time runs: what is proposed waits for the approval."""
        return self.until < UNSTARTED

    def restarted(self, now: datetime) -> Lease:
        """Return the lease with its whole term to run from ``now``."""
        return Term(self.seconds, self.slack).lease_from(now)

    @property
    def expires_at(self) -> datetime:
        """When the claim may be released: after every renewal that was not recorded."""
        return self.until + timedelta(seconds=self.slack)

    def renewed(self, term: Term, now: datetime) -> Lease:
        """Return the lease after a renewal; the same one where the record covers it.

        The end never moves to an earlier time: the clock may have been set back.
        """
        wanted = term.lease_from(now)
        if (self.seconds, self.slack) == (
            term.seconds,
            term.slack,
        ) and wanted.until <= self.expires_at:
            return self
        return replace(wanted, until=max(wanted.until, self.until))


def renewed(standing: Lease | None, term: Term | None, now: datetime) -> Lease | None:
    """Return the lease of a claim that is asked for again; nothing where it has no end."""
    if term is None:
        return None
    return standing.renewed(term, now) if standing else term.lease_from(now)
