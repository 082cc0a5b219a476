"""What the tests of every controller share: a ROS domain, a client in it, and progress."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.common.ros import Client
from tests.e2e.rig.capture import uncaptured
from tests.e2e.rig.tools import Report
from tests.ros_domain import reserved


@pytest.fixture(scope="session")
def say(request: pytest.FixtureRequest) -> Report:
    return uncaptured(request.config)


@pytest.fixture(scope="session")
def ros_domain() -> Iterator[int]:
    """A ROS domain for this process, so that nothing else answers."""
    with reserved() as domain:
        yield domain


@pytest.fixture(scope="session")
def client(ros_domain: int) -> Iterator[Client]:
    made = Client(ros_domain)
    yield made
    made.close()
