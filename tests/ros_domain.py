"""A ROS domain for each test process, also where several checkouts are tested at once."""

from __future__ import annotations

import fcntl
import os
import random
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_LAST = 100
"""Above it the ports of a domain are among those that Linux gives to any socket."""


@contextmanager
def reserved() -> Iterator[int]:
    """Hold a domain that nobody on this machine uses, and talk on this machine only."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    domains = list(range(1, _LAST + 1))
    random.shuffle(domains)
    for domain in domains:
        path = Path(tempfile.gettempdir()) / f"ros-domain-{domain}.lock"
        with path.open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            if _is_free(domain):
                yield domain
                return
    raise RuntimeError(f"all {_LAST} ROS domains are in use on this machine")


def _is_free(domain: int) -> bool:
    """Tell whether nobody listens where the domain's first participant would."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", 7400 + 250 * domain + 10))
        except OSError:
            return False
    return True
