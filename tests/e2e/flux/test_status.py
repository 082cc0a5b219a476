"""The requester hears what came of it: goals answered at reconciled or healthy, and why not."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import yaml

from ros_bridge.client import DemandClient, DemandError
from tests.e2e.common.staterepo import demandops
from tests.e2e.rig.cluster import Rig

from .conftest import CLUSTER, MakeWorld
from .test_wake import limited, wake_file
from .view import Domain
from .world import World

TIMEOUT_S = 60.0
SHORT_S = 6.0
POINTS = "/vehicles/vehicle00/drivers/lidar/pointcloud"
FUSION: dict[str, Any] = {
    "id": "edge/fusion",
    "type": "object-detection-fusion",
    "node": "edge",
    "inputs": {
        "ego_data": [{"topic": "/vehicles/vehicle00/ego_data", "source": "vehicle00"}],
        "point_cloud": [{"topic": POINTS, "source": "vehicle00"}],
    },
}


def documented_rights() -> list[dict[str, Any]]:
    """The rights that docs/status.md asks for."""
    page = (Path(__file__).parents[3] / "docs" / "status.md").read_text()
    (role,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    rules: list[dict[str, Any]] = yaml.safe_load(role)["rules"]
    return rules


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    made = make_world()
    domain = made.bootstrap(CLUSTER, rig)
    rights = limited(domain, rig.kubeconfig, made.folder, documented_rights())
    started(made, wake_file(made.folder, rights), TIMEOUT_S)
    return made


def started(world: World, file: Path, timeout_s: float) -> None:
    world.generator.stop()
    arguments = ("--clusters", str(file), "--ros-args", "-p", f"answer_timeout:={timeout_s}")
    world.generator.start(*arguments)


@pytest.fixture
def asker(ros_domain: int) -> Iterator[DemandClient]:
    with DemandClient("vehicle00", domain_id=ros_domain, timeout_s=2 * TIMEOUT_S) as made:
        yield made


def unavailable(domain: Domain) -> list[str]:
    """The Deployments that are not there whole at this moment."""
    return [
        item["metadata"]["name"]
        for item in domain.find("Deployment")
        if (item.get("status") or {}).get("availableReplicas", 0) < item["spec"]["replicas"]
    ]


def test_answered_at_healthy_when_it_is_and_at_gone_when_it_is(
    world: World, asker: DemandClient
) -> None:
    domain = world.domain
    told: list[str] = []
    with asker.demand("d", [FUSION], answer="healthy", told=lambda s, _: told.append(s)) as held:
        names = {item["metadata"]["name"] for item in domain.find("Deployment")}
        assert unavailable(domain) == []
        assert {"od-edge-vehicle00"} < names and len(names) == 4
        assert held.answer is not None and held.answer.reached == "healthy"
        assert told[-2:] == ["reconciled", "healthy"]
        assert domain.applied() == held.commit
    domain.wait_applied(world.tip())  # the release, which was answered at pushed
    answer = asker.put("d", [FUSION], answer="healthy")
    assert answer.outcome == "booked"
    file = str(world.folder / "clusters.yaml")
    told_json = demandops(
        world.folder,
        "status",
        "--state-repo",
        world.push_url,
        "--clusters",
        file,
        "--output",
        "json",
    )
    status = json.loads(told_json)
    assert {row["health"] for row in status["releases"]} == {"healthy"}
    assert {row["seen"] for row in status["releases"]} == {status["commit"]} == {answer.commit}
    assert all(row["since"] for row in status["releases"]) and len(status["releases"]) == 4
    gone = asker.send({"operation": "release", "demand": "d", "answer": "healthy"})
    assert gone.reached == "healthy"
    assert domain.find("HelmRelease") == [] and domain.find("Deployment") == []


@pytest.fixture
def edge_is_full(rig: Rig) -> Iterator[Any]:
    """No pod is scheduled on the edge until it is called."""
    (edge,) = rig.kube.find("Node", selector="node_id=edge")

    def unschedulable(value: bool | None) -> None:
        rig.kube.patch("Node", edge["metadata"]["name"], {"spec": {"unschedulable": value}})

    unschedulable(True)
    yield lambda: unschedulable(None)
    unschedulable(None)


def test_not_answered_before_it_is_healthy(
    world: World, asker: DemandClient, edge_is_full: Any
) -> None:
    """Reconciled comes at once; healthy waits until the edge takes pods again."""
    reconciled = threading.Event()

    def told(stage: str, text: str) -> None:
        if stage == "reconciled":
            reconciled.set()

    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(asker.put, "d", [FUSION], answer="healthy", told=told)
        assert reconciled.wait(TIMEOUT_S)
        time.sleep(2)
        assert not waiting.done()
        assert unavailable(world.domain) != []
        edge_is_full()
        assert waiting.result(TIMEOUT_S).reached == "healthy"
    assert unavailable(world.domain) == []
    asker.release("d")


def test_what_cannot_become_ready_is_told_with_the_reason_in_time(
    world: World, asker: DemandClient, edge_is_full: Any, rig: Rig
) -> None:
    started(world, world.folder / "clusters.yaml", SHORT_S)
    start = time.monotonic()
    with pytest.raises(DemandError) as caught:
        asker.put("d", [FUSION], answer="healthy")
    assert caught.value.code == "not-healthy"
    assert time.monotonic() - start < 3 * SHORT_S
    said = str(caught.value)
    assert "Deployment perception/" in said and "not scheduled: " in said
    assert f"it is booked in {world.tip()}" in said
    # nothing was lost: the demand stands, and is healthy once the edge takes pods
    edge_is_full()
    started(world, world.folder / "clusters.yaml", TIMEOUT_S)
    assert asker.put("d", [FUSION], answer="healthy").outcome == "unchanged"
    asker.release("d")


def test_what_the_controller_refuses_is_told_in_its_words(
    world: World, asker: DemandClient
) -> None:
    """A chart that cannot be installed; the goal says which release, and what Helm says of it."""
    started(world, world.folder / "clusters.yaml", SHORT_S)
    chart = "appdefs/object-detection-fusion/charts/object-detection/templates/deployment.yaml"
    versions = {
        "appdefs/object-detection-fusion/charts/object-detection/Chart.yaml": "version: ",
        "registry/charts.yaml": "charts/object-detection\n    version: ",
    }
    whole = {path: world.file(path) for path in (chart, *versions)}
    broken = {
        path: whole[path].replace(f"{before}0.1.0", f"{before}0.1.1")
        for path, before in versions.items()
    }
    world.push({**broken, chart: whole[chart] + '{{ fail "no lidar here" }}\n'})
    with pytest.raises(DemandError) as caught:
        asker.put("d", [FUSION], answer="healthy")
    assert caught.value.code == "not-healthy"
    assert "HelmRelease perception/od-edge-vehicle00: " in str(caught.value)
    assert "no lidar here" in str(caught.value)
    world.push(dict(whole))
    started(world, world.folder / "clusters.yaml", TIMEOUT_S)
    assert asker.put("d", [FUSION], answer="healthy").reached == "healthy"
    asker.release("d")


def test_an_api_server_that_is_killed_delays_the_answer_and_loses_nothing(
    world: World, asker: DemandClient, rig: Rig
) -> None:
    if rig.existing:
        pytest.skip("this cluster's API server is not ours to kill")
    rig.kill("kube-apiserver")
    try:
        with ThreadPoolExecutor(1) as pool:
            pushed = threading.Event()
            waiting = pool.submit(
                asker.put,
                "d",
                [FUSION],
                answer="healthy",
                told=lambda stage, _: pushed.set() if stage == "pushed" else None,
            )
            assert pushed.wait(TIMEOUT_S)
            time.sleep(1)
            assert not waiting.done()
            rig.start_component("kube-apiserver")
            assert waiting.result(2 * TIMEOUT_S).reached == "healthy"
    finally:
        rig.restart("kube-apiserver")
    assert unavailable(world.domain) == []
    asker.release("d")
