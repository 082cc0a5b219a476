"""Fixtures for the tests of both controllers: a ROS domain, its clients, and progress messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from demandops_ros import DemandClient

from tests.e2e.common.ros import Client
from tests.e2e.rig.capture import uncaptured
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report
from tests.kit.ros import reserved

pytest.register_assert_rewrite("tests.e2e.common.answers", "tests.e2e.common.steps")


@pytest.fixture(autouse=True)
def limited() -> None:
    """Set no time limit for these tests, because each of their waits has its own time-out."""


@pytest.fixture(scope="session")
def say(request: pytest.FixtureRequest) -> Report:
    return uncaptured(request.config)


@pytest.fixture(scope="session")
def ros_domain() -> Iterator[int]:
    """A ROS domain that only this process uses."""
    with reserved() as domain:
        yield domain


@pytest.fixture(scope="session")
def client(ros_domain: int) -> Iterator[Client]:
    made = Client(ros_domain)
    yield made
    made.close()


@pytest.fixture
def requester(ros_domain: int) -> Iterator[DemandClient]:
    with DemandClient("vehicle00", domain_id=ros_domain, timeout_s=120) as made:
        yield made


@pytest.fixture
def edge_is_full(rig: Rig) -> Iterator[Callable[[], None]]:
    """Keep pods from being scheduled on the edge; yield a function that allows it again."""
    (edge,) = rig.kube.find("Node", selector="node_id=edge")

    def unschedulable(value: bool | None) -> None:
        rig.kube.patch("Node", edge["metadata"]["name"], {"spec": {"unschedulable": value}})

    unschedulable(True)
    yield lambda: unschedulable(None)
    unschedulable(None)
