"""A demand for another version updates the services, and its end restores the old version."""

from __future__ import annotations

import json

import yaml

from tests.e2e.common import expected
from tests.e2e.common.expected import DETECTION, FUSION
from tests.e2e.common.staterepo import demandops

from .world import World

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"


def test_an_update_by_demand_and_back(world: World) -> None:
    domain = world.domain
    world.push({APPDEF: definition(world), "registry/versions.yaml": versions()})
    world.follow(world.demand(expected.demand(1)), expected.after(1))
    domain.wait_releases()
    before, fusion = images(world), domain.identity(FUSION)

    request(world, PUT)
    updated = {name: before[name].rpartition(":")[0] + ":next" for name in DETECTION.values()}
    domain.kube.wait("the pods of the update", lambda: images(world) == before | updated)
    domain.wait_lines(expected.after(1))
    assert domain.identity(FUSION) == fusion, (
        "the fusion, whose image is the same in both versions, was restarted"
    )

    request(world, PUT | {"operation": "release", "applications": []})
    domain.kube.wait("the pods of before", lambda: images(world) == before)
    domain.wait_lines(expected.after(1))
    assert domain.identity(FUSION) == fusion


PUT = {
    "kind": "Demand",
    "demand": "try-next",
    "requesters": ["vehicle02"],
    "applications": [
        {
            "id": "edge/object_detection_fusion",
            "type": "object-detection-fusion",
            "node": "edge",
            "version": "testing",
            "connect": "none",
            "inputs": {
                "point_cloud": [{"topic": "/stations/station00/pointcloud", "source": "station00"}]
            },
        }
    ],
}


def definition(world: World) -> str:
    return world.file(APPDEF).replace("inputs:\n", "versions: update\ninputs:\n", 1)


def versions() -> str:
    next_one = {"images": {"object-detection": {"tag": "next"}}}
    listed = {"1.0.0": {}, "1.1.0": next_one}
    entry = {"default": "1.0.0", "channels": {"testing": "1.1.0"}, "versions": listed}
    head = {"apiVersion": "demandops/v1", "kind": "Versions"}
    return yaml.safe_dump(head | {"applications": {"object-detection-fusion": entry}})


def request(world: World, goal: dict[str, object]) -> None:
    """Send a `Demand` by `demandops request`; wait until Flux has applied its commit.

    The command runs beside the generator.
    """
    file = world.folder / "demand.yaml"
    file.write_text(json.dumps(goal))
    demandops(world.folder, "request", str(file), "--state-repo", world.push_url)
    world.domain.wake()
    world.domain.wait_applied(world.tip())


def images(world: World) -> dict[str, str]:
    """Return the image of each service's pod by release, without pods that are being deleted."""
    return {
        name: pod["spec"]["containers"][0]["image"]
        for name in (*DETECTION.values(), FUSION)
        for pod in world.domain.find("Pod", name)
        if "deletionTimestamp" not in pod["metadata"]
    }
