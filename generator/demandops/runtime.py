"""Time, chance and threads: the only module that asks the machine for them.

The service and the cluster's watchers take a :class:`Runtime`. A test can pass its own, with a
clock that it moves, numbers from a seed, and threads that take turns. An object with a state repo
uses the repo's runtime. Commands, git's processes and locks, HTTP and ROS's executors always use
:data:`REAL`.
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
    """The runtime of this machine; a subclass overrides the methods that it replaces."""

    def now(self) -> datetime:
        """Return the time in UTC; a person may set this clock."""
        return datetime.now(timezone.utc)

    def monotonic(self) -> float:
        """Return the seconds of a clock that nobody can set; only differences have a meaning."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Block the calling thread."""
        time.sleep(seconds)

    def uniform(self, low: float, high: float) -> float:
        """Return a random number in a range; not for security."""
        return random.uniform(low, high)  # noqa: S311 - see above

    def fresh_id(self) -> str:
        """Return a unique id."""
        return str(uuid.uuid4())

    def lock(self) -> threading.Lock:
        """Return a lock that is held only briefly, never during a wait."""
        return threading.Lock()

    def event(self) -> threading.Event:
        """Return an event that threads wait for."""
        return threading.Event()

    def condition(self) -> threading.Condition:
        """Return a lock whose holders may wait for a change; a wait may end without a change."""
        return threading.Condition()

    def start_thread(self, name: str, target: Callable[[], object]) -> Thread:
        """Start a thread that ends with the process at the latest, and return it."""
        thread = Thread(target=target, name=f"demandops-{name}", daemon=True)
        thread.start()
        return thread


REAL = Runtime()
