"""When demands are answered, and what an answer and `demand status` say of the cluster.

A demand is answered when it is reconciled or healthy; its field ``answer`` says which. If the
demand cannot become so, the answer says why.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from demandops_ros import DemandClient, DemandError

from tests.e2e.common import expected
from tests.e2e.common.access import TIMEOUT_S, limited_world, restart_generator
from tests.e2e.common.domain import Domain, fusion_inputs
from tests.e2e.common.expected import WITHOUT_DEMANDS, target_end
from tests.e2e.common.goals import EGO, application
from tests.e2e.common.rendered import DETECTION_TEMPLATE, raised
from tests.e2e.common.world import World
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Rig

SHORT_S = 6.0
FUSED = application("edge/fusion", ego_data=["vehicle00"], point_cloud=["vehicle00"])


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    return limited_world(make_world(), rig)


def unavailable(domain: Domain) -> list[str]:
    return [
        item["metadata"]["name"]
        for item in domain.find("Deployment")
        if (item.get("status") or {}).get("availableReplicas", 0) < item["spec"]["replicas"]
    ]


def status(world: World) -> dict[str, Any]:
    options = ("--clusters", str(world.folder / "clusters.yaml"), "--output", "json")
    found: dict[str, Any] = json.loads(world.demandops("status", *options, or_exit=1))
    return found


def test_answered_when_it_is_healthy_and_when_it_is_gone(
    world: World, requester: DemandClient
) -> None:
    domain = world.domain
    stages: list[str] = []
    with requester.demand(
        "d", [FUSED], answer="healthy", on_stage=lambda stage, _: stages.append(stage)
    ) as held:
        names = domain.names("Deployment")
        assert unavailable(domain) == []
        assert {"od-edge-vehicle00"} < names and len(names) == 6
        assert held.answer is not None and held.answer.reached == "healthy"
        assert stages[-2:] == ["reconciled", "healthy"]
        assert domain.applied() == held.commit
    domain.wait_applied(world.tip())  # the `with` block waits only for the push
    answer = requester.put("d", [FUSED], answer="healthy")
    assert answer.outcome == "booked"
    seen = status(world)
    assert {row["health"] for row in seen["releases"]} == {"healthy"}
    assert {row["seen"] for row in seen["releases"]} == {seen["commit"]} == {answer.commit}
    assert all(row["since"] for row in seen["releases"]) and len(seen["releases"]) == 6
    assert seen["old_bootstraps"] == []
    gone = requester.send({"operation": "release", "demand": "d", "answer": "healthy"})
    assert gone.reached == "healthy"
    assert domain.find(domain.RELEASE) == [] and domain.find("Deployment") == []


def test_a_change_is_healthy_when_the_changed_service_runs(
    world: World, requester: DemandClient
) -> None:
    """The answer waits for the health after the change, not for the health before it."""
    domain = world.domain
    requester.put("d", [FUSED], answer="healthy")
    (params,) = (name for name in domain.names("ConfigMap") if name.endswith("-params"))
    for others in (["vehicle01"], [], ["vehicle02"]):
        vehicles = ["vehicle00", *others]
        changed = application("edge/fusion", ego_data=vehicles, point_cloud=["vehicle00"])
        answer = requester.put("d", [changed], answer="healthy")
        taken = fusion_inputs(domain.get("ConfigMap", params))
        wanted = {EGO.format(vehicle) for vehicle in vehicles}
        assert {topic for topic in taken if topic.endswith("ego_data")} == wanted, answer
        assert unavailable(domain) == []
    requester.send({"operation": "release", "demand": "d", "answer": "healthy"})


def wait_not_healthy(world: World, requester: DemandClient, *reasons: str) -> None:
    """Demand until the answer, which comes after a short time, has these reasons."""

    def told() -> bool:
        with pytest.raises(DemandError) as caught:
            requester.put("d", [FUSED], answer="healthy")
        message = str(caught.value)
        assert caught.value.code == "not-healthy"
        assert re.search(f"the demand is (booked|unchanged) in {world.tip()}", message)
        return all(reason in message for reason in reasons)

    world.domain.wait(" ".join(reasons), told)


def test_what_cannot_become_ready_is_reported_in_time_with_the_reason(
    world: World, requester: DemandClient, edge_is_full: Callable[[], None]
) -> None:
    restart_generator(world, SHORT_S)
    wait_not_healthy(world, requester, "Deployment perception/", "not scheduled: ")
    # the demand is still booked, and becomes healthy once the edge accepts pods
    edge_is_full()
    restart_generator(world)
    assert requester.put("d", [FUSED], answer="healthy").outcome == "unchanged"
    requester.release("d")


def test_a_refusal_of_the_controller_is_reported_with_its_reason(
    world: World, requester: DemandClient
) -> None:
    restart_generator(world, SHORT_S)
    broken = raised(world, "object-detection")
    broken[DETECTION_TEMPLATE] = world.file(DETECTION_TEMPLATE) + '{{ fail "no lidar here" }}\n'
    old: dict[str, str | None] = {path: world.file(path) for path in broken}
    world.push(broken)
    release = f"{world.domain.RELEASE} perception/od-edge-vehicle00: "
    wait_not_healthy(world, requester, release, "no lidar here")
    world.push(old)
    restart_generator(world)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(requester.put, "d", [FUSED], answer="healthy")
        world.domain.read_chart("od-edge-vehicle00")
        assert waiting.result(2 * TIMEOUT_S).reached == "healthy"
    requester.release("d")


def test_an_api_server_that_is_killed_delays_the_answer_and_loses_nothing(
    world: World, requester: DemandClient, rig: Rig
) -> None:
    parts = rig.parts
    restart_generator(world)
    parts.kill("kube-apiserver")
    try:
        with ThreadPoolExecutor(1) as pool:
            pushed = threading.Event()
            waiting = pool.submit(
                requester.put,
                "d",
                [FUSED],
                answer="healthy",
                on_stage=lambda stage, _: pushed.set() if stage == "pushed" else None,
            )
            assert pushed.wait(TIMEOUT_S)
            assert not waiting.done()
            parts.start("kube-apiserver")
            assert waiting.result(2 * TIMEOUT_S).reached == "healthy"
    finally:
        if "kube-apiserver" not in parts.pids():
            parts.start("kube-apiserver")
    assert unavailable(world.domain) == []
    requester.release("d")


@pytest.mark.only("flux", "only Flux was seen to forget objects")
def test_what_flux_forgot_is_named_and_its_command_deletes_it(world: World) -> None:
    domain, name = world.domain, target_end("station00")
    world.step(1, expected.after(1))
    forgotten = domain.get("Deployment", name)
    kept = ("name", "namespace", "labels")
    metadata = {key: forgotten["metadata"][key] for key in kept} | {"name": "forgotten"}
    domain.kube.apply(
        {"apiVersion": "apps/v1", "kind": "Deployment", "metadata": metadata}
        | {"spec": forgotten["spec"]}
    )
    (orphan,) = status(world)["orphans"]
    assert (orphan["kind"], orphan["name"]) == ("Deployment", "forgotten")
    administrator = os.environ | {"KUBECONFIG": str(world.rig.kubeconfig)}
    subprocess.run(orphan["command"].split(), env=administrator, check=True)
    assert status(world)["orphans"] == []
    world.follow(world.demand(expected.demand(1) | {"shutdown": True}), WITHOUT_DEMANDS)
