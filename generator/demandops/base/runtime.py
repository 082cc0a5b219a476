"""Time, random numbers and threads: only this module takes them from the machine.

The generator and the watchers of clusters take a :class:`Runtime`. A test can pass its own, with a
clock that it moves, numbers from a seed, and threads that take turns. An object that gets an
open state repo uses the runtime of this state repo. Commands, git's processes and locks, HTTP and
ROS's executors always use :data:`REAL`.

This module also supervises the threads, so that no thread fails unnoticed.
"""

from __future__ import annotations

import logging
import random
import threading
import time
import uuid
from collections.abc import Callable
from datetime import datetime, timezone

from demandops.base.errors import DemandOpsError, Unsound

log = logging.getLogger("demandops")  # of the whole program

Thread = threading.Thread

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0
# A thread counts as recovered if its last failure is at least this many seconds ago
_STEADY_S = 2 * _LONGEST_PAUSE_S
_LONGEST_REASON = 300


class Runtime:
    def __init__(self) -> None:
        self._failures: dict[str, tuple[str, float]] = {}
        # the error because of which the process must end, and what is called after it
        self.unsound: Unsound | None = None
        self.when_unsound: Callable[[], object] = lambda: None

    def now(self) -> datetime:
        # it may jump, because a person may set the clock
        return datetime.now(timezone.utc)

    def monotonic(self) -> float:
        # nobody can set this clock, so only its differences have a meaning
        return time.monotonic()

    def processor_s(self) -> float:
        # of the calling thread only
        return time.thread_time()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def uniform(self, low: float, high: float) -> float:
        return random.uniform(low, high)  # noqa: S311 - for pauses, not for secrets

    def fresh_id(self) -> str:
        return str(uuid.uuid4())

    # whoever takes a lock must hold it briefly, and not wait while holding it
    def lock(self) -> threading.Lock:
        return threading.Lock()

    def event(self) -> threading.Event:
        return threading.Event()

    def condition(self) -> threading.Condition:
        # a wait for it may end without a notification
        return threading.Condition()

    def start_thread(self, name: str, target: Callable[[], object]) -> Thread:
        # a daemon ends with the process: no thread of ours must keep it from ending
        thread = Thread(target=target, name=f"demandops-{name}", daemon=True)
        thread.start()
        return thread

    # ---- supervision ----

    @property
    def failures(self) -> dict[str, str]:
        # the last one of each thread that has not recovered since
        now = self.monotonic()
        failures = sorted(self._failures.items())
        return {name: text for name, (text, at) in failures if now - at < _STEADY_S}

    def failed(self, name: str, error: Exception) -> None:
        # a fault that lasts, such as a host that is down, must not fill the log
        is_known = self.failures.get(name) == _reason(error)
        self._failures[name] = (_reason(error), self.monotonic())
        if is_known:
            log.debug("%s failed again: %s", name, _reason(error))
        elif isinstance(error, DemandOpsError):
            log.error("%s", error)
        else:
            log.error("internal error in %s: %s", name, _reason(error), exc_info=error)

    def recovered(self, name: str) -> None:
        if self._failures.pop(name, None):
            log.info("%s works again", name)

    def keep_running(self, name: str, target: Callable[[], object]) -> Thread:
        """Start a thread that runs ``target``, again after each error until ``target`` returns.

        The thread also ends after :class:`Unsound`, because the process must end.
        """

        def supervise() -> None:
            pause = _FIRST_PAUSE_S
            while True:
                began = self.monotonic()
                try:
                    target()
                except Unsound as error:
                    log.critical("%s; the process ends", error)
                    self.unsound = error
                    self.when_unsound()
                    return
                except Exception as error:
                    self.failed(name, error)
                else:
                    return
                if self.monotonic() - began > _STEADY_S:  # not the same fault again and again
                    pause = _FIRST_PAUSE_S
                self.sleep(pause)
                pause = min(2 * pause, _LONGEST_PAUSE_S)

        return self.start_thread(name, supervise)


def _reason(error: Exception) -> str:
    text = str(error) if isinstance(error, DemandOpsError) else repr(error)
    return " ".join(text.split())[:_LONGEST_REASON]


REAL = Runtime()
