"""Merged overrides reach the cluster, stay in effect while demands come, and end when removed."""

from __future__ import annotations

import yaml

from tests.e2e.common import expected
from tests.e2e.common.expected import DETECTION, FUSION, source_end
from tests.e2e.common.manual import requested_by

from .world import World

DETECTIONS = {"services": ["object-detection"]}


def override(select: dict[str, list[str]], **effects: object) -> str:
    head = {"apiVersion": "demandops/v1", "kind": "Override", "reason": "a test", "owner": "petra"}
    return yaml.safe_dump(head | {"select": [select]} | effects)


def test_overrides_arrive_stay_and_go(world: World) -> None:
    domain, goal = world.domain, expected.demand(1)
    world.follow(world.demand(goal), expected.after(1))
    domain.wait_releases()
    fusion = domain.identity(FUSION)
    client = source_end("vehicle00")

    def replicas(name: str) -> int:
        count: int = domain.get("Deployment", name)["spec"]["replicas"]
        return count

    world.push(
        {
            "overrides/many.yaml": override(DETECTIONS, replicas=2),
            "overrides/patched.yaml": override(
                {"services": ["object-detection"], "requesters": ["vehicle00"]},
                values={"tolerations": [{"operator": "Exists"}]},
            ),
            "overrides/pinned.yaml": override(
                {"connections": ["vehicle00/*"]}, images={"mqtt-client": {"tag": "pinned"}}
            ),
        }
    )
    for vehicle in ("vehicle02", "vehicle03"):  # the first demand's commit applies the overrides
        sent = world.demand(requested_by(vehicle, goal))
        domain.wake()
        domain.wait_applied(sent.commit)
        for name in DETECTION.values():
            domain.kube.wait(f"two of {name}", lambda n=name: replicas(n) == 2)
            spec = domain.get("Deployment", name)["spec"]["template"]["spec"]
            assert {"operator": "Exists"} in spec["tolerations"]
        (container,) = domain.get("Deployment", client)["spec"]["template"]["spec"]["containers"]
        assert container["image"].endswith(":pinned")
    assert domain.identity(FUSION) == fusion, "an override changed the fusion"
    world.push({f"overrides/{name}.yaml": None for name in ("many", "patched", "pinned")})
    world.demand(requested_by("vehicle02", goal) | {"shutdown": True})
    sent = world.demand(requested_by("vehicle03", goal) | {"shutdown": True})
    world.follow(sent, expected.after(1))
    for name in DETECTION.values():
        domain.kube.wait(f"one of {name}", lambda n=name: replicas(n) == 1)
    assert domain.identity(FUSION) == fusion


def test_a_denial_stops_a_service_and_a_keep_restores_it(world: World) -> None:
    goal = expected.demand(1)
    world.follow(world.demand(goal), expected.after(1))
    fields = yaml.safe_load(override({"nodes": ["*"]}, deny=True))
    world.push({"overrides/closed.yaml": yaml.safe_dump(fields)})
    sent = world.demand(goal)  # the claims stay booked while they are denied
    world.follow(sent, expected.WITHOUT_DEMANDS)
    fields["keep"] = fields.pop("deny")
    world.push({"overrides/closed.yaml": yaml.safe_dump(fields)})
    world.follow(world.demand(goal), expected.after(1))
    world.follow(world.demand(goal | {"shutdown": True}), expected.after(1))
    world.push({"overrides/closed.yaml": None})
    world.follow(world.demand(goal), expected.after(1))
    world.follow(world.demand(goal | {"shutdown": True}), expected.WITHOUT_DEMANDS)
