"""Schedules: the days and hours at which a rule's demand is wanted."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, time, timedelta, tzinfo

DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")


@dataclass(frozen=True, slots=True)
class Schedule:
    """A span of hours on certain days of the week.

    If ``end`` is before ``start``, the span lasts past midnight. ``days`` are the days on which a
    span starts, as numbers; Monday is 0.
    """

    days: frozenset[int]
    start: time
    end: time
    zone: tzinfo

    def is_on(self, now: float) -> bool:
        """Return whether ``now``, in seconds since 1970 UTC, is in the span of hours."""
        local = datetime.fromtimestamp(now, self.zone)
        clock, today = local.time(), local.weekday()
        if self.start < self.end:
            return today in self.days and self.start <= clock < self.end
        yesterday = (today - 1) % 7
        return (today in self.days and clock >= self.start) or (
            yesterday in self.days and clock < self.end
        )

    def next_check(self, now: float) -> float:
        """Return the time after ``now`` at which to call :meth:`is_on` again."""
        local = datetime.fromtimestamp(now, self.zone)
        # The result of :meth:`is_on` changes at a start, at an end, and if summer time begins or
        # ends. To notice the latter soon, an hour is the longest time.
        ahead = [now + 3600.0]
        for day in (0, 1):
            date = local.date() + timedelta(days=day)
            for at in (self.start, self.end):
                ahead.append(datetime.combine(date, at, self.zone).timestamp())
        return min(moment for moment in ahead if moment > now)
