"""Fixtures: nodes in processes of their own, and clients, with rclpy in separate ROS domains."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from demandops_ros import DemandClient

from tests.kit import repo
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import GitRepo, init, tip
from tests.kit.rig import wait_until
from tests.kit.ros import Client, Serve, Served, Servers, reserved
from tests.scenarios import running


@pytest.fixture
def servers(tmp_path: Path, data_home: Path, ros_domain: int) -> Iterator[Servers]:
    """Starts commands that use ROS; commands that still run at the end of the test are killed."""
    made = Servers(tmp_path, ros_domain)
    yield made
    made.kill()


@pytest.fixture
def serve(servers: Servers, new_repo: Callable[[str], Path]) -> Serve:
    """Return a function that starts a node, by default with a state repo of its own."""

    def start(state_repo: str | Path | None = None, *args: str) -> Served:
        return servers.start(str(state_repo or new_repo("state.git")), *args)

    return start


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    made = Client(ros_domain)
    yield made
    made.close()


# ---- one node for all tests that neither restart it nor change its set-up ----


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A node that serves many tests; each test uses ids of its own.

    The node's state repo has the recorder as a further type of application.
    """
    folder = tmp_path_factory.mktemp("shared")
    bare = init(folder / "state.git")
    repo.force_writes_in(bare, False)
    changed = GitRepo(bare).commit({**running.configuration(["recorder"])})
    with reserved() as domain:
        servers = Servers(folder, domain, DEMANDOPS_DATA_HOME=str(folder / "home"))
        served = servers.start(str(bare))
        wait_until(lambda: tip(bare) != changed, "the node has followed the change")
        yield served
        servers.kill()


@pytest.fixture(scope="session")
def caller(shared: Served) -> Iterator[Client]:
    """A client of the shared node for the reference's action."""
    made = Client(shared.domain)
    made.ready()
    yield made
    made.close()


@pytest.fixture(scope="session")
def vehicle(shared: Served) -> Iterator[DemandClient]:
    """A client of the shared node for DemandOps' own action."""
    with DemandClient("vehicle00", domain_id=shared.domain, timeout_s=PATIENCE_S) as made:
        yield made
