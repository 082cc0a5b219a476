"""What the tests of every controller share: a ROS domain, a client in it, and progress."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.common.ros import Client
from tests.e2e.rig.capture import uncaptured
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report
from tests.kit.ros import reserved

pytest.register_assert_rewrite("tests.e2e.common.answers")


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


@pytest.fixture
def edge_is_full(rig: Rig) -> Iterator[None]:
    """No pod is scheduled on the edge, as when an image cannot be pulled there."""
    (edge,) = rig.kube.find("Node", selector="node_id=edge")
    for state, whole in ((True, False), (False, True)):
        if whole:
            yield
        name = edge["metadata"]["name"]
        rig.kube.patch("Node", name, {"spec": {"unschedulable": state or None}})
