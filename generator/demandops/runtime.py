"""Time, chance and threads: the only module that asks the machine for them.

The service and the cluster's watchers are handed a :class:`Runtime`, so that another one can run
them: with a clock that it moves, numbers from a seed, and threads that take turns. What holds a
state repo takes that of the repository. What belongs to this machine in any case uses
:data:`REAL`: commands, git's processes and locks, HTTP, ROS's executors.
"""

from __future__ import annotations

import random
import threading
import time
import uuid
from collections.abc import Callable
from datetime import datetime, timezone

Thread = threading.Thread


class Runtime:
    """The runtime of this machine; another one overrides what it replaces."""

    def now(self) -> datetime:
        """Return the time in UTC, by a clock that a person may set."""
        return datetime.now(timezone.utc)

    def monotonic(self) -> float:
        """Return the seconds of a clock that nobody sets; only differences have a meaning."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Block the calling thread."""
        time.sleep(seconds)

    def uniform(self, low: float, high: float) -> float:
        """Return a random number between two others; not for security."""
        return random.uniform(low, high)  # noqa: S311 - see above

    def fresh_id(self) -> str:
        """Return an id that nobody else has."""
        return str(uuid.uuid4())

    def lock(self) -> threading.Lock:
        """Return a lock that is held only briefly, never during a wait."""
        return threading.Lock()

    def event(self) -> threading.Event:
        """Return an event that threads wait for."""
        return threading.Event()

    def condition(self) -> threading.Condition:
        """Return a lock whose holders may wait for a change. A wait may end without one."""
        return threading.Condition()

    def start_thread(self, name: str, target: Callable[[], object]) -> Thread:
        """Start a thread that ends with the process at the latest, and return it."""
        thread = Thread(target=target, name=f"demandops-{name}", daemon=True)
        thread.start()
        return thread


REAL = Runtime()
