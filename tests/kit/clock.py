"""Runtimes that tests control: a clock that they move, and threads that take turns."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Collection, Iterable
from datetime import datetime, timedelta
from math import inf
from typing import Any

from demandops.base.runtime import Runtime
from greenlet import getcurrent, greenlet

from tests.kit.memory import NOW

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


# ---- threads that take turns ----


class Turns(Clock):
    """A runtime whose threads take turns when they wait; a wait only moves the clock."""

    def __init__(self, seed: int) -> None:
        super().__init__(NOW)
        self.chance = random.Random(seed)
        self._main = self._turn = getcurrent()
        self._waiting: dict[greenlet, tuple[Callable[[], bool], float]] = {}

    def uniform(self, low: float, high: float) -> float:
        return self.chance.uniform(low, high)

    def fresh_id(self) -> str:
        return f"{self.chance.getrandbits(128):032x}"

    def sleep(self, seconds: float) -> None:
        self.wait(lambda: False, seconds)

    def event(self) -> Any:
        return _Event(self)

    def condition(self) -> Any:
        return _Condition(self)

    def start_thread(self, name: str, target: Callable[[], object]) -> Any:
        thread = _Thread(target, self._main)
        thread.turns = self
        self._waiting[thread] = (lambda: True, inf)
        return thread

    def wait(self, is_over: Callable[[], bool], timeout: float | None = None) -> None:
        me = getcurrent()
        self._waiting[me] = (is_over, inf if timeout is None else self.monotonic() + timeout)
        self._turn = self._next()
        while self._turn is not me:
            self._turn.switch()
            if self._turn.dead:  # an ended thread switches to the main one
                self._turn = self._next()

    def stop(self, threads: Collection[greenlet]) -> None:
        for thread in threads:
            self._waiting.pop(thread, None)
        while getcurrent() in threads:
            self._turn = self._next()
            self._turn.switch()

    def end(self, threads: Iterable[greenlet]) -> None:
        """Unwind stopped threads, so that they release their resources."""
        self._waiting.clear()
        for thread in threads:
            self._turn = self._main
            thread.throw()

    def _next(self) -> greenlet:
        """Return a random thread that can go on, after the next timeout if none can."""
        free = [one for one, (is_over, _) in self._waiting.items() if is_over()]
        if not free:
            end = min(end for _, end in self._waiting.values())
            assert end < inf, "all threads wait for each other"
            self._passed = max(self._passed, end)
            free = [one for one, (_, until) in self._waiting.items() if until <= self._passed]
        chosen = self.chance.choice(free)
        del self._waiting[chosen]
        return chosen


class _Thread(greenlet):
    turns: Turns

    def is_alive(self) -> bool:
        return not self.dead

    def join(self, timeout: float | None = None) -> None:
        self.turns.wait(lambda: self.dead, timeout)


class _Event:
    def __init__(self, turns: Turns) -> None:
        self._turns, self._is_set = turns, False

    def is_set(self) -> bool:
        return self._is_set

    def set(self) -> None:
        self._is_set = True

    def clear(self) -> None:
        self._is_set = False

    def wait(self, timeout: float | None = None) -> bool:
        self._turns.wait(self.is_set, timeout)
        return self._is_set


class _Condition:
    """A condition variable that needs no lock, because a thread keeps its turn until it waits."""

    def __init__(self, turns: Turns) -> None:
        self._turns, self._changes = turns, 0

    def __enter__(self) -> None:
        pass

    def __exit__(self, *reason: object) -> None:
        pass

    def notify(self) -> None:
        self._changes += 1

    def wait(self, timeout: float | None = None) -> None:
        seen = self._changes
        self._turns.wait(lambda: self._changes != seen, timeout)
