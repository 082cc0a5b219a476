"""The ROS 2 action client of `tests.kit`, with a thread of its own that spins it.

The thread records the time of each feedback even while a test waits for the cluster.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from tests.kit import ros
from tests.kit.goals import Goal
from tests.kit.limits import PATIENCE_S
from tests.kit.ros import Sent


class Client(ros.Client):
    def __init__(self, domain: int) -> None:
        super().__init__(domain)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._over.is_set():
            self.executor.spin_once()

    def wait(self, condition: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "the condition did not hold in time"
            time.sleep(0.005)

    def send(self, goal: Goal) -> Sent:
        """Send a goal from the thread that spins; in other threads, rclpy may lose responses."""
        sent: list[Sent] = []
        self.executor.create_task(lambda: sent.append(super(Client, self).send(goal)))
        self.wait(lambda: bool(sent))
        return sent[0]

    def call(self, sent: Goal) -> Sent:
        """Send a goal until a node takes it; for a while a client still sees a killed node."""
        end = time.monotonic() + PATIENCE_S
        under_way, since = self.send(sent), time.monotonic()
        while not under_way.accepted:
            assert time.monotonic() < end, "no node accepts the goal"
            if time.monotonic() - since > 3:
                under_way, since = self.send(sent), time.monotonic()
            time.sleep(0.005)
        self.wait(lambda: under_way.answered)
        return under_way

    def close(self) -> None:
        self._over.set()
        self.executor.create_task(lambda: None)  # wakes the thread
        self._thread.join(PATIENCE_S)
        super().close()
