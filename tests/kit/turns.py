"""A runtime that runs all its threads in one real thread; a seed determines the order and times."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Iterable
from math import inf
from typing import Any

from greenlet import getcurrent, greenlet

from tests.kit.clock import Clock
from tests.kit.memory import NOW


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
