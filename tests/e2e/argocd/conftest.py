"""One cluster with Argo CD for all tests here, and for each module a state repo that it follows."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.common.expected import NODES, WITHOUT_DEMANDS
from tests.e2e.common.ros import Client
from tests.e2e.common.running import running
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report

from .world import World

CLUSTER = "c-its"


@pytest.fixture(scope="session")
def rig(request: pytest.FixtureRequest, say: Report) -> Iterator[Rig]:
    """A cluster with a node for each node of the skeleton's inventory."""
    with running(
        Rig(CLUSTER, gitops="argocd", nodes=NODES, report=say), request.session
    ) as cluster:
        say(f"\nrig started: {cluster.timings}")
        yield cluster


@pytest.fixture(scope="module")
def world(
    rig: Rig, client: Client, ros_domain: int, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[World]:
    """A state repo that the cluster follows, with a running generator and no demand."""
    made = World(rig, tmp_path_factory.mktemp("world"), ros_domain, client)
    try:
        made.bootstrap(CLUSTER)
        made.generator.start()
        made.domain.wait_lines(WITHOUT_DEMANDS)
        yield made
    finally:
        made.remove()
