"""Tests of when demands are answered; they run with Flux and with Argo CD.

A demand is answered when it is reconciled or healthy; its field ``answer`` says which. If the
demand cannot become so, the answer says why.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from demandops_ros import DemandClient, DemandError

from tests.e2e.common.access import access_file, documented_roles, limited
from tests.e2e.common.expected import CLUSTER
from tests.e2e.common.namespace import Namespace, fusion_inputs, name_of
from tests.e2e.common.world import World, demandops
from tests.e2e.rig.cluster import Rig

TIMEOUT_S = 60.0
RECOVERY_S = 110.0
"""The time-out of an answer after an outage of the API server.

Argo CD must first watch the server again and compare all its objects.
"""
SHORT_S = 6.0
CHARTS = "appdefs/object-detection-fusion/charts"
CHART = f"{CHARTS}/object-detection/templates/service.yaml"
_VERSIONS = {
    f"{CHARTS}/object-detection/Chart.yaml": "version: ",
    "registry/charts.yaml": "charts/object-detection\n    version: ",
}
_POINTS = "/vehicles/vehicle00/drivers/lidar/pointcloud"


def ego(vehicle: str) -> dict[str, str]:
    return {"topic": f"/vehicles/{vehicle}/ego_data", "source": vehicle}


def fusion(*vehicles: str) -> dict[str, Any]:
    """Return a fusion of these vehicles' ego data and of the first vehicle's point cloud."""
    cloud = {"topic": _POINTS, "source": "vehicle00"}
    return {
        "id": "edge/fusion",
        "type": "object-detection-fusion",
        "node": "edge",
        "inputs": {"ego_data": [ego(vehicle) for vehicle in vehicles], "point_cloud": [cloud]},
    }


FUSION = fusion("vehicle00")


def limited_world(world: World, rig: Rig) -> World:
    """Let the cluster follow a new state repo; its generator gets the rights of docs/status.md."""
    world.bootstrap(CLUSTER, rig)
    rights = documented_roles(rig.gitops)
    kubeconfig = limited(rig.kube, rig.kubeconfig, world.folder, rights)
    access_file(world.folder, {CLUSTER: {"kubeconfig": kubeconfig}})
    restart_generator(world, TIMEOUT_S)
    return world


@pytest.fixture(scope="module")
def world(make_world: Callable[[], World], rig: Rig) -> World:
    return limited_world(make_world(), rig)


def restart_generator(world: World, timeout_s: float) -> None:
    world.generator.stop()
    file = str(world.folder / "clusters.yaml")
    world.generator.start("--clusters", file, "--ros-args", "-p", f"answer_timeout:={timeout_s}")


def unavailable(domain: Namespace) -> list[str]:
    return [
        name_of(item)
        for item in domain.find("Deployment")
        if (item.get("status") or {}).get("availableReplicas", 0) < item["spec"]["replicas"]
    ]


def push_chart(world: World, added: str) -> dict[str, str]:
    """Add text to the detection's chart, as a new version; return the former content by path."""
    old = {path: world.file(path) for path in (CHART, *_VERSIONS)}
    new = {
        path: old[path].replace(f"{before}0.1.0", f"{before}0.1.1")
        for path, before in _VERSIONS.items()
    }
    world.push({**new, CHART: old[CHART] + added})
    return old


def test_answered_when_it_is_healthy_and_when_it_is_gone(
    world: World, requester: DemandClient
) -> None:
    domain = world.domain
    stages: list[str] = []
    with requester.demand(
        "d", [FUSION], answer="healthy", on_stage=lambda stage, _: stages.append(stage)
    ) as held:
        names = {name_of(item) for item in domain.find("Deployment")}
        assert unavailable(domain) == []
        assert {"od-edge-vehicle00"} < names and len(names) == 6
        assert held.answer is not None and held.answer.reached == "healthy"
        assert stages[-2:] == ["reconciled", "healthy"]
        assert domain.applied() == held.commit
    domain.wait_applied(world.tip())  # the `with` block waits only for the push
    answer = requester.put("d", [FUSION], answer="healthy")
    assert answer.outcome == "booked"
    file = str(world.folder / "clusters.yaml")
    where = ("--state-repo", world.push_url, "--clusters", file, "--output", "json")
    status = json.loads(demandops(world.folder, "status", *where))
    assert {row["health"] for row in status["releases"]} == {"healthy"}
    assert {row["seen"] for row in status["releases"]} == {status["commit"]} == {answer.commit}
    assert all(row["since"] for row in status["releases"]) and len(status["releases"]) == 6
    assert status["old_bootstraps"] == []
    gone = requester.send({"operation": "release", "demand": "d", "answer": "healthy"})
    assert gone.reached == "healthy"
    assert domain.find(domain.RELEASE) == [] and domain.find("Deployment") == []


def test_a_change_is_healthy_when_the_changed_service_runs(
    world: World, requester: DemandClient
) -> None:
    """The answer waits for the health after the change, not for the health before it."""
    domain = world.domain
    requester.put("d", [FUSION], answer="healthy")
    for vehicles in (("vehicle00", "vehicle01"), ("vehicle00",), ("vehicle00", "vehicle02")):
        answer = requester.put("d", [fusion(*vehicles)], answer="healthy")
        (config,) = [
            item
            for item in domain.find("ConfigMap")
            if name_of(item).startswith("of-edge-") and name_of(item).endswith("-params")
        ]
        inputs = {topic for topic in fusion_inputs(config) if topic.endswith("ego_data")}
        assert {ego(vehicle)["topic"] for vehicle in vehicles} == inputs, answer
        assert unavailable(domain) == []
    requester.send({"operation": "release", "demand": "d", "answer": "healthy"})


def test_what_cannot_become_ready_is_reported_in_time_with_the_reason(
    world: World, requester: DemandClient, edge_is_full: Callable[[], None]
) -> None:
    restart_generator(world, SHORT_S)
    with pytest.raises(DemandError) as caught:
        requester.put("d", [FUSION], answer="healthy")
    assert caught.value.code == "not-healthy"
    message = str(caught.value)
    assert "Deployment perception/" in message and "not scheduled: " in message
    assert f"the demand is booked in {world.tip()}" in message
    # the demand is still booked, and becomes healthy once the edge accepts pods
    edge_is_full()
    restart_generator(world, TIMEOUT_S)
    assert requester.put("d", [FUSION], answer="healthy").outcome == "unchanged"
    requester.release("d")


def test_a_refusal_of_the_controller_is_reported_with_its_reason(
    world: World, requester: DemandClient
) -> None:
    """The answer names the release that cannot be installed, and the controller's reason."""
    restart_generator(world, SHORT_S)
    old = push_chart(world, '{{ fail "no lidar here" }}\n')
    with pytest.raises(DemandError) as caught:
        requester.put("d", [FUSION], answer="healthy")
    assert caught.value.code == "not-healthy"
    assert f"{world.domain.RELEASE} perception/od-edge-vehicle00: " in str(caught.value)
    assert "no lidar here" in str(caught.value)
    world.push(dict(old))
    restart_generator(world, TIMEOUT_S)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(requester.put, "d", [FUSION], answer="healthy")
        world.domain.read_chart("od-edge-vehicle00")
        assert waiting.result(2 * TIMEOUT_S).reached == "healthy"
    requester.release("d")


def test_an_api_server_that_is_killed_delays_the_answer_and_loses_nothing(
    world: World, requester: DemandClient, rig: Rig
) -> None:
    if rig.existing:
        pytest.skip("the tests may not kill the API server of an existing cluster")
    restart_generator(world, RECOVERY_S)
    rig.parts.kill("kube-apiserver")
    try:
        with ThreadPoolExecutor(1) as pool:
            pushed = threading.Event()
            waiting = pool.submit(
                requester.put,
                "d",
                [FUSION],
                answer="healthy",
                on_stage=lambda stage, _: pushed.set() if stage == "pushed" else None,
            )
            assert pushed.wait(TIMEOUT_S)
            assert not waiting.done()
            rig.parts.start("kube-apiserver")
            assert waiting.result(RECOVERY_S + 10).reached == "healthy"
    finally:
        if "kube-apiserver" not in rig.parts.pids():
            rig.parts.start("kube-apiserver")
    assert unavailable(world.domain) == []
    requester.release("d")
