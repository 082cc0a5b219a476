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

from demandops.errors import DemandOpsError, Unsound

log = logging.getLogger("demandops")

Thread = threading.Thread

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0
# A thread counts as recovered if its last failure is at least this many seconds ago
_STEADY_S = 2 * _LONGEST_PAUSE_S
_LONGEST_REASON = 300


class Runtime:
    """Time, random numbers and threads of this machine; a test's subclass replaces them.

    ``unsound`` is the error because of which the process must end, or None. ``when_unsound`` is
    called after such an error.
    """

    def __init__(self) -> None:
        self._failures: dict[str, tuple[str, float]] = {}
        self.unsound: Unsound | None = None
        self.when_unsound: Callable[[], object] = lambda: None

    def now(self) -> datetime:
        """Return the time in UTC. It may jump, because a person may set the clock."""
        return datetime.now(timezone.utc)

    def monotonic(self) -> float:
        """Return the seconds of a clock that nobody can set; only differences have a meaning."""
        return time.monotonic()

    def processor_s(self) -> float:
        """Return the seconds of processor time that the calling thread has used so far."""
        return time.thread_time()

    def sleep(self, seconds: float) -> None:
        """Block the calling thread."""
        time.sleep(seconds)

    def uniform(self, low: float, high: float) -> float:
        """Return a random number in a range. It is not random enough for secrets."""
        return random.uniform(low, high)  # noqa: S311 - see above

    def fresh_id(self) -> str:
        """Return a unique id."""
        return str(uuid.uuid4())

    def lock(self) -> threading.Lock:
        """Return a new lock. The caller must hold it briefly, and not wait while holding it."""
        return threading.Lock()

    def event(self) -> threading.Event:
        """Return an event that threads wait for."""
        return threading.Event()

    def condition(self) -> threading.Condition:
        """Return a new condition variable; a wait for it may end without a notification."""
        return threading.Condition()

    def start_thread(self, name: str, target: Callable[[], object]) -> Thread:
        """Start a thread that runs ``target``, and return the thread.

        The thread ends with the process at the latest.
        """
        thread = Thread(target=target, name=f"demandops-{name}", daemon=True)
        thread.start()
        return thread

    # ---- supervision ----

    @property
    def failures(self) -> dict[str, str]:
        """The last failure of each thread that has not recovered since, by the thread's name.

        A failure is over if :meth:`recovered` is called, or after two minutes.
        """
        now = self.monotonic()
        known = sorted(self._failures.items())
        return {name: text for name, (text, at) in known if now - at < _STEADY_S}

    def failed(self, name: str, error: Exception) -> None:
        """Record that the work of a thread failed, and log the error.

        If the thread's last failure was the same and is not over yet (:attr:`failures`), the error
        is logged at the level DEBUG only.
        """
        is_known = self.failures.get(name) == _reason(error)
        self._failures[name] = (_reason(error), self.monotonic())
        if is_known:
            log.debug("%s failed again: %s", name, _reason(error))
        elif isinstance(error, DemandOpsError):
            log.error("%s", error)
        else:
            log.error("internal error in %s: %s", name, _reason(error), exc_info=error)

    def recovered(self, name: str) -> None:
        """Record that the work of a thread succeeded."""
        if self._failures.pop(name, None):
            log.info("%s works again", name)

    def keep_running(self, name: str, target: Callable[[], object]) -> Thread:
        """Start a thread that runs ``target``, and return the thread.

        If ``target`` raises an error, the thread pauses and runs ``target`` again. The pause grows
        with each error, up to a minute. The thread ends if ``target`` returns. It also ends after
        :class:`Unsound`, because the process must end.
        """
        return self.start_thread(name, lambda: self._supervise(name, target))

    def _supervise(self, name: str, target: Callable[[], object]) -> None:
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
            if self.monotonic() - began > _STEADY_S:
                pause = _FIRST_PAUSE_S
            self.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_S)


def _reason(error: Exception) -> str:
    text = str(error) if isinstance(error, DemandOpsError) else repr(error)
    return " ".join(text.split())[:_LONGEST_REASON]


REAL = Runtime()
