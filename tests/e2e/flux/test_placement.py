"""Services that the generator places wait for room, leave a drained node, and run side by side.

Each application has a fusion that needs a GPU, which two nodes have. The connections of a service
move together with it. A service that need not move is not restarted.
"""

from __future__ import annotations

from typing import Any

import yaml
from demandops.base.naming import object_name
from demandops_ros import DemandClient

from tests.e2e.common.expected import WITHOUT_DEMANDS
from tests.e2e.common.namespace import Pods, wait_for_pods
from tests.e2e.common.world import World
from tests.kit.config import override

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
NODES, BROKERS = "inventory/nodes.yaml", "inventory/brokers.yaml"
DOMAINS, VERSIONS = "policy/access-domains.yaml", "registry/versions.yaml"
OVERRIDE = "overrides/away.yaml"


def test_services_wait_follow_a_drain_and_an_override_and_run_apart(
    world: World, requester: DemandClient
) -> None:
    world.push(definitions(world) | gpus(world, cloud=1, station00=0))
    first = application("first", "vehicle00")
    first["deliver"] = [{"output": "object-fusion.fused_objects", "node": "vehicle00"}]
    assert requester.put("first", [first]).outcome == "booked"
    wait_for(world, fused("first", "vehicle00", "cloud", delivered=True))

    second = application("second", "vehicle01")
    assert requester.put("second", [second]).outcome == "waiting"
    merge(world, requester, gpus(world, cloud=1, station00=1))
    on_station = fused("second", "vehicle01", "station00")
    wait_for(world, fused("first", "vehicle00", "cloud", delivered=True) | on_station)
    before = world.domain.uids()

    merge(world, requester, gpus(world, cloud=1, station00=3, drained="cloud"))
    wait_for(world, fused("first", "vehicle00", "station00", delivered=True) | on_station)
    stays = [name for name in before if name.startswith("of-second")]
    assert stays
    assert {n: world.domain.uids()[n] for n in stays} == {n: before[n] for n in stays}

    first_fusion = {"applications": ["first"], "services": ["object-fusion"]}
    merge(world, requester, {OVERRIDE: override(first_fusion, node="edge")})
    moved = fused("first", "vehicle00", "edge", delivered=True)
    wait_for(world, moved | on_station)

    assert requester.put("third", [second | {"version": "testing"}]).warnings
    wait_for(world, moved | on_station | {("of-second-1-1-0", "station00")})
    merge(world, requester, {OVERRIDE: None})
    back = fused("first", "vehicle00", "station00", delivered=True)
    wait_for(world, back | on_station | {("of-second-1-1-0", "station00")})

    for demand in ("first", "second", "third"):
        requester.release(demand)
    wait_for(world, set())
    world.domain.wait_lines(WITHOUT_DEMANDS)


def merge(world: World, requester: DemandClient, files: dict[str, str | None]) -> None:
    """Push files as a person; then renew a demand, so that the generator fetches at once."""
    world.push(files)
    requester.renew("first")


def application(id: str, vehicle: str) -> dict[str, Any]:
    inputs = {"ego_data": [{"topic": f"/vehicles/{vehicle}/ego_data", "source": vehicle}]}
    return {"id": id, "type": "object-detection-fusion", "node": "edge", "inputs": inputs}


def fused(id: str, vehicle: str, node: str, *, delivered: bool = False) -> Pods:
    ways = [(vehicle, node, f"/vehicles/{vehicle}/ego_data")]
    ways += [(node, vehicle, f"/{id}_global_objectlist")] if delivered else []
    clients = {
        (object_name("mqtt", f"derived/{source}/{target}{topic}", side), end)
        for source, target, topic in ways
        for side, end in (("source", source), ("target", target))
    }
    return {(f"of-{id}", node), *clients}


def wait_for(world: World, wanted: Pods) -> None:
    wait_for_pods({world.domain: wanted})


def definitions(world: World) -> dict[str, str | None]:
    appdef = yaml.safe_load(world.file(APPDEF))
    appdef["versions"] = "separate"
    appdef["services"]["object-fusion"] |= {
        "place": {"capabilities": ["gpu"]},
        "requests": {"gpu": 1},
    }
    brokers = yaml.safe_load(world.file(BROKERS))
    brokers["brokers"] = [{"node": one, "host": one} for one in ("edge", "cloud", "station00")]
    domains = yaml.safe_load(world.file(DOMAINS))
    domains["domains"][0]["whenFull"] = "wait"
    listed = {"1.0.0": {}, "1.1.0": {"images": {"object-fusion": {"tag": "next"}}}}
    entry = {"default": "1.0.0", "channels": {"testing": "1.1.0"}, "versions": listed}
    versions = {"apiVersion": "demandops/v1", "kind": "Versions"}
    versions |= {"applications": {"object-detection-fusion": entry}}
    data = {APPDEF: appdef, BROKERS: brokers, DOMAINS: domains, VERSIONS: versions}
    return {path: yaml.safe_dump(content) for path, content in data.items()}


def gpus(world: World, *, drained: str = "", **count: int) -> dict[str, str | None]:
    """Return the inventory file with these numbers of GPUs by node, and one node drained."""
    inventory = yaml.safe_load(world.file(NODES))
    for node in inventory["nodes"]:
        if node["id"] in count:
            node |= {"capabilities": ["gpu"], "capacity": {"gpu": count[node["id"]]}}
        node["drained"] = node["id"] == drained
    return {NODES: yaml.safe_dump(inventory)}
