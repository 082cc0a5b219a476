"""Overrides that a person merges arrive in the cluster, stay through demands, and go again."""

from __future__ import annotations

import yaml

from tests.e2e.common import expected
from tests.e2e.common.byhand import asked_by
from tests.e2e.common.expected import DETECTION, FUSION, source_end

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
    for vehicle in ("vehicle02", "vehicle03"):  # the first takes them in
        sent = world.demand(asked_by(vehicle, goal))
        domain.wake()
        domain.wait_applied(sent.commit)
        for name in DETECTION.values():
            domain.kube.wait(f"two of {name}", lambda n=name: replicas(n) == 2)
            spec = domain.get("Deployment", name)["spec"]["template"]["spec"]
            assert {"operator": "Exists"} in spec["tolerations"]
        (container,) = domain.get("Deployment", client)["spec"]["template"]["spec"]["containers"]
        assert container["image"].endswith(":pinned")
    assert domain.identity(FUSION) == fusion, "what no override is for is left alone"
    world.push({f"overrides/{name}.yaml": None for name in ("many", "patched", "pinned")})
    world.demand(asked_by("vehicle02", goal) | {"shutdown": True})
    sent = world.demand(asked_by("vehicle03", goal) | {"shutdown": True})
    world.follow(sent, expected.after(1))
    for name in DETECTION.values():
        domain.kube.wait(f"one of {name}", lambda n=name: replicas(n) == 1)
    assert domain.identity(FUSION) == fusion


def test_a_denial_stops_what_runs_and_a_keep_lets_it_run_on(world: World) -> None:
    goal = expected.demand(1)
    world.follow(world.demand(goal), expected.after(1))
    fields = yaml.safe_load(override({"nodes": ["*"]}, deny=True))
    world.push({"overrides/closed.yaml": yaml.safe_dump(fields)})
    sent = world.demand(goal)  # what it asks for stands, and is suspended
    world.follow(sent, expected.STANDING)
    fields["keep"] = fields.pop("deny")
    world.push({"overrides/closed.yaml": yaml.safe_dump(fields)})
    world.follow(world.demand(goal), expected.after(1))
    world.follow(world.demand(goal | {"shutdown": True}), expected.after(1))
    world.push({"overrides/closed.yaml": None})
    world.follow(world.demand(goal), expected.after(1))
    world.follow(world.demand(goal | {"shutdown": True}), expected.STANDING)
