"""Fixtures for the end-to-end tests, which run once with each GitOps controller.

A test that uses `rig`, or what is made of it, runs as `…[flux]` and as `…[argocd]`, with the
markers `flux` and `argocd`. `only` marks what one controller alone can do, or what does not depend
on the controller: `@pytest.mark.only("flux", "why")`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from demandops_ros import DemandClient

from tests.e2e.common.expected import CLUSTER, NODES
from tests.e2e.common.intrusion import FILE, NEIGHBOUR, withdraw
from tests.e2e.common.world import DOMAINS, World
from tests.e2e.rig.cluster import Gitops, Rig
from tests.e2e.rig.kube import Manifest, build_manifest
from tests.e2e.rig.tools import Report
from tests.kit.limits import PATIENCE_S
from tests.kit.ros import Client

MakeWorld = Callable[[], World]
SlipIn = Callable[..., None]


def pytest_configure(config: pytest.Config) -> None:
    for name in DOMAINS:
        config.addinivalue_line("markers", f"{name}: needs a cluster with this controller")
    config.addinivalue_line("markers", "only(gitops, reason): runs with this controller alone")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "gitops" not in metafunc.fixturenames:
        return
    only = metafunc.definition.get_closest_marker("only")
    variants = []
    for name in DOMAINS:
        marks = [getattr(pytest.mark, name)]
        if only and name != only.args[0]:
            marks.append(pytest.mark.skip(reason=only.args[1]))
        variants.append(pytest.param(name, marks=marks))
    metafunc.parametrize("gitops", variants, indirect=True, scope="session")


@pytest.fixture(autouse=True)
def limited() -> None:
    """Set no time limit for these tests, because each of their waits has its own time-out."""


@pytest.fixture(scope="session")
def say(request: pytest.FixtureRequest) -> Report:
    """Return a function that prints past pytest's capture; a cold build takes twenty minutes."""
    capture: Any = request.config.pluginmanager.getplugin("capturemanager")

    def say(text: str) -> None:
        with capture.global_and_fixture_disabled():
            print(text, file=sys.stderr, flush=True)

    return say


@pytest.fixture(scope="session")
def gitops(request: pytest.FixtureRequest) -> Gitops:
    controller: Gitops = request.param
    return controller


@pytest.fixture(scope="session")
def rig(gitops: Gitops, tmp_path_factory: pytest.TempPathFactory, say: Report) -> Iterator[Rig]:
    """One cluster for all tests with a controller."""
    folder = tmp_path_factory.mktemp(f"rig-{gitops}")
    with Rig(CLUSTER, folder, gitops=gitops, nodes=NODES, report=say) as rig:
        yield rig


@pytest.fixture(scope="session")
def client(ros_domain: int) -> Iterator[Client]:
    made = Client(ros_domain)
    yield made
    made.close()


@pytest.fixture(scope="module")
def make_world(
    rig: Rig, client: Client, ros_domain: int, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MakeWorld]:
    """Return a function that creates a state repo, which no cluster follows yet.

    It removes the one before: a cluster follows one, and a ROS domain has one generator.
    """
    made: list[World] = []

    def make() -> World:
        for world in made:
            world.remove()
        made.append(World(rig, tmp_path_factory.mktemp("world"), ros_domain, client))
        return made[-1]

    yield make
    for world in made:
        world.remove()


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    """A state repo that the cluster follows, with a running generator and no demand."""
    made = make_world()
    made.begin(rig)
    return made


@pytest.fixture
def requester(ros_domain: int) -> Iterator[DemandClient]:
    with DemandClient("vehicle00", domain_id=ros_domain, timeout_s=2 * PATIENCE_S) as made:
        yield made


@pytest.fixture
def edge_is_full(rig: Rig) -> Iterator[Callable[[], None]]:
    """Keep pods from being scheduled on the edge; yield a function that allows it again."""

    def unschedulable(value: bool | None) -> None:
        rig.kube.patch("Node", "edge", {"spec": {"unschedulable": value}})

    unschedulable(True)
    yield lambda: unschedulable(None)
    unschedulable(None)


@pytest.fixture(scope="module")
def neighbour(rig: Rig) -> Iterator[Any]:
    rig.kube.apply(build_manifest("v1", "Namespace", NEIGHBOUR))
    # Kubernetes creates the service account and the ConfigMap
    rig.kube.wait("the account", lambda: rig.kube.get("ServiceAccount", "default", NEIGHBOUR))
    rig.kube.wait("the root", lambda: rig.kube.get("ConfigMap", "kube-root-ca.crt", NEIGHBOUR))
    yield DOMAINS[rig.gitops](rig.kube, NEIGHBOUR, "none")
    rig.kube.delete("Namespace", NEIGHBOUR)


@pytest.fixture
def slip_in(world: World, neighbour: Any) -> Iterator[SlipIn]:
    """Return a function that commits manifests to the domain's folder.

    The function waits until the controller has tried to apply the manifests. The fixture removes
    the manifests after the test.
    """

    def push(*manifests: Manifest, file: str = FILE) -> None:
        commit = world.push({file: "\n---\n".join(map(json.dumps, manifests))})
        world.domain.wake()
        world.domain.wait_attempted(commit)

    yield push
    withdraw(world)
