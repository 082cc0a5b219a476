"""A clock that tests move instead of waiting."""

from __future__ import annotations

import threading
from datetime import datetime, timedelta

from demandops.base.runtime import Runtime

_LONGEST_WAIT_S = 0.05


class Clock(Runtime):
    """A runtime whose clocks a test moves.

    With a ``start``, only the test moves the clocks, and ``uniform`` always returns its upper
    bound. Without a ``start``, real time passes as well. Each look at the processor time lets
    ``look_s`` of it pass, and nothing else does, so no result depends on how fast a machine is.
    """

    look_s = 0.0

    def __init__(self, start: datetime | None = None) -> None:
        super().__init__()
        self._start = start
        self._passed = self._set = self._worked = 0.0

    def now(self) -> datetime:
        return (self._start or super().now()) + timedelta(seconds=self._passed + self._set)

    def monotonic(self) -> float:
        return self._passed if self._start else self._passed + super().monotonic()

    def processor_s(self) -> float:
        self._worked += self.look_s
        return self._worked

    def uniform(self, low: float, high: float) -> float:
        return high if self._start else super().uniform(low, high)

    def condition(self) -> threading.Condition:
        return _Impatient()

    @property
    def offset(self) -> float:
        return self._set

    def pass_(self, seconds: float) -> None:
        self._passed += seconds

    def set_by(self, seconds: float) -> None:
        """Set the wall clock forward or back; the monotonic clock stays as it is."""
        self._set += seconds


class _Impatient(threading.Condition):
    def wait(self, timeout: float | None = None) -> bool:
        return super().wait(_LONGEST_WAIT_S if timeout is None else min(timeout, _LONGEST_WAIT_S))
