"""Fixtures: one cluster with Argo CD for all tests, and a state repo for each test module."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from tests.e2e.common.expected import CLUSTER, NODES, WITHOUT_DEMANDS
from tests.e2e.common.ros import Client
from tests.e2e.common.running import running, worlds
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report

from .world import World

MakeWorld = Callable[[], World]


@pytest.fixture(scope="session")
def rig(request: pytest.FixtureRequest, say: Report) -> Iterator[Rig]:
    """A cluster with a fake node for each node of the skeleton's inventory."""
    cluster = Rig(CLUSTER, gitops="argocd", nodes=NODES, report=say)
    with running(cluster, request.session):
        say(f"\nrig started: {cluster.timings}")
        yield cluster


@pytest.fixture(scope="module")
def make_world(
    rig: Rig, client: Client, ros_domain: int, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MakeWorld]:
    """Return a function that creates a state repo, which no cluster follows yet.

    The fixture removes these state repos after the module's last test.
    """
    folder = tmp_path_factory.mktemp
    with worlds(lambda: World(rig, folder("world"), ros_domain, client)) as make:
        yield make


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    """A state repo that the cluster follows, with a running generator and no demand."""
    made = make_world()
    made.bootstrap(CLUSTER, rig)
    made.generator.start()
    made.domain.wait_lines(WITHOUT_DEMANDS)
    return made
