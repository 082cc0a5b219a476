"""Applications of several services: where their pods run, and what changes let run on.

Each connection moves with its service, and a service that need not move is not restarted.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.naming import object_name
from demandops_ros import DemandClient

from tests.e2e.common.domain import Pods, wait_for_pods
from tests.e2e.common.expected import WITHOUT_DEMANDS
from tests.e2e.common.goals import CLOUD, EGO, application
from tests.e2e.common.world import World
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Rig
from tests.kit.config import override

EXAMPLE = Path(__file__).parents[2] / "examples" / "lane-detection"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
CHARTS, IMAGES = "registry/charts.yaml", "registry/images.yaml"
NODES, BROKERS = "inventory/nodes.yaml", "inventory/brokers.yaml"
DOMAINS, VERSIONS = "policy/access-domains.yaml", "registry/versions.yaml"
OVERRIDE = "overrides/away.yaml"
PLAN = "/edge_object_detection_fusion_plan"

Files = dict[str, str | None]


@pytest.fixture
def world(make_world: MakeWorld, rig: Rig) -> Iterator[World]:
    """A state repo for one test, because each test has other definitions."""
    made = make_world()
    made.begin(rig)
    yield made
    made.remove()


def carried(source: str, target: str, topic: str) -> Pods:
    """Return the two clients that carry a topic from one node to another."""
    id = f"derived/{source}/{target}{topic}"
    ends = {"source": source, "target": target}
    return {(object_name("mqtt", id, side), node) for side, node in ends.items()}


def test_four_services_on_three_nodes_serve_two_vehicles(
    world: World, requester: DemandClient
) -> None:
    """Each vehicle has a driver; at the edge are a detection for each, a fusion, and a planner.

    The chart of driver and planner is in a folder that the bootstrap file did not know.
    """
    domain = world.domain
    world.push(four_services(world))
    at_first = domain.inventory()
    put_trip(requester, "vehicle00", "vehicle01")
    wait_for_pods({domain: trip("vehicle00", "vehicle01")})
    domain.wait_releases()
    before = domain.uids()

    put_trip(requester, "vehicle00")
    wait_for_pods({domain: trip("vehicle00")})
    domain.wait_releases()
    assert domain.pods() == trip("vehicle00"), "the namespace changed again"
    after = domain.uids()
    assert after.items() <= before.items(), "a pod that both demands need was restarted"

    requester.release("trip")
    domain.wake()
    domain.wait_lines(WITHOUT_DEMANDS)
    chart = domain.inventory() & {"HelmChart ros-launch-0.2.0"}  # Flux has it from now on
    domain.wait_inventory(at_first | chart)


def put_trip(requester: DemandClient, *vehicles: str) -> None:
    deliver = [{"output": "planner.plan", "node": vehicle} for vehicle in vehicles]
    topics: dict[str, Any] = {"ego_data": vehicles, "point_cloud": vehicles, "deliver": deliver}
    demanded = application("edge/object_detection_fusion", **topics)
    assert requester.put("trip", [demanded]).warnings == ()


def trip(*vehicles: str) -> Pods:
    pods: Pods = {(f"{name}-edge-object-detection-fusion", "edge") for name in ("of", "plan")}
    for vehicle in vehicles:
        pods |= {(f"lidar-{vehicle}-{vehicle}", vehicle), (f"od-edge-{vehicle}", "edge")}
        pods |= carried(vehicle, "edge", f"/{vehicle}_points")
        pods |= carried(vehicle, "edge", EGO.format(vehicle)) | carried("edge", vehicle, PLAN)
    return pods


def four_services(world: World) -> Files:
    """Return the example's appdefs with a planner, and the registry and nodes that fit them."""
    files = {
        path.relative_to(EXAMPLE).as_posix(): path.read_text()
        for path in (EXAMPLE / "appdefs").rglob("*")
        if path.is_file()
    }
    appdef = yaml.safe_load(files[APPDEF])
    appdef["services"]["planner"] = {
        "prefix": "plan",
        "inputs": {"objects": "object-fusion.fused_objects"},
        "outputs": {"plan": "/{instance}_plan"},
        "chart": "ros-launch",
        "images": ["planner"],
        "values": "values/planner.yaml.j2",
    }
    charts, images, nodes = (yaml.safe_load(world.file(path)) for path in (CHARTS, IMAGES, NODES))
    folder = "appdefs/lane-detection/charts/ros-launch"
    charts["charts"]["ros-launch"] = {"folder": folder, "version": "0.2.0"}
    for name in ("lidar-driver", "lane-detection", "planner"):
        images["images"][name] = {"repository": f"registry.example/{name}", "tag": "1.0.0"}
    for node in nodes["nodes"]:
        if node["type"] == "vehicle":
            node["topics"]["point_cloud"] = CLOUD.format(node["id"])
    values = f"{Path(APPDEF).parent}/values/planner.yaml.j2"
    data = {APPDEF: appdef, CHARTS: charts, IMAGES: images, NODES: nodes}
    return {
        **files,
        values: Path(__file__).with_name("planner.yaml.j2").read_text(),
        **{path: yaml.safe_dump(content) for path, content in data.items()},
    }


def test_services_wait_follow_a_drain_and_an_override_and_run_apart(
    world: World, requester: DemandClient
) -> None:
    """Each application has a fusion that needs a GPU, which two nodes have."""
    domain = world.domain

    def merge(files: Files) -> None:
        world.push(files)
        requester.renew("first")  # so that the generator fetches at once

    world.push(gpu_fusion(world) | gpus(world, cloud=1, station00=0))
    deliver = [{"output": "object-fusion.fused_objects", "node": "vehicle00"}]
    requester.put("first", [application("first", ego_data=["vehicle00"], deliver=deliver)])
    wait_for_pods({domain: fused("first", "vehicle00", "cloud")})

    second = application("second", ego_data=["vehicle01"])
    assert requester.put("second", [second]).outcome == "waiting"
    merge(gpus(world, cloud=1, station00=1))
    on_station = fused("second", "vehicle01", "station00")
    wait_for_pods({domain: fused("first", "vehicle00", "cloud") | on_station})
    stays = {name: pod for name, pod in domain.uids().items() if name.startswith("of-second")}
    assert stays

    merge(gpus(world, cloud=1, station00=3, drained="cloud"))
    wait_for_pods({domain: fused("first", "vehicle00", "station00") | on_station})
    assert stays.items() <= domain.uids().items()

    first_fusion = {"applications": ["first"], "services": ["object-fusion"]}
    merge({OVERRIDE: override(first_fusion, node="edge")})
    moved = fused("first", "vehicle00", "edge")
    wait_for_pods({domain: moved | on_station})

    assert requester.put("third", [second | {"version": "testing"}]).warnings
    apart = on_station | {("of-second-1-1-0", "station00")}
    wait_for_pods({domain: moved | apart})
    merge({OVERRIDE: None})
    wait_for_pods({domain: fused("first", "vehicle00", "station00") | apart})

    for demand in ("first", "second", "third"):
        requester.release(demand)
    wait_for_pods({domain: set()})
    domain.wait_lines(WITHOUT_DEMANDS)


def fused(id: str, vehicle: str, node: str) -> Pods:
    back = carried(node, vehicle, f"/{id}_global_objectlist") if id == "first" else set()
    return {(f"of-{id}", node), *carried(vehicle, node, EGO.format(vehicle)), *back}


def gpu_fusion(world: World) -> Files:
    """Return files by which a fusion needs a GPU, waits if none is free, and has two versions."""
    appdef, brokers, domains = (yaml.safe_load(world.file(p)) for p in (APPDEF, BROKERS, DOMAINS))
    appdef["versions"] = "separate"
    fusion = {"place": {"capabilities": ["gpu"]}, "requests": {"gpu": 1}}
    appdef["services"]["object-fusion"] |= fusion
    brokers["brokers"] = [{"node": one, "host": one} for one in ("edge", "cloud", "station00")]
    domains["domains"][0]["whenFull"] = "wait"
    listed = {"1.0.0": {}, "1.1.0": {"images": {"object-fusion": {"tag": "next"}}}}
    entry = {"default": "1.0.0", "channels": {"testing": "1.1.0"}, "versions": listed}
    versions = {"apiVersion": "demandops/v1", "kind": "Versions"}
    versions |= {"applications": {"object-detection-fusion": entry}}
    data = {APPDEF: appdef, BROKERS: brokers, DOMAINS: domains, VERSIONS: versions}
    return {path: yaml.safe_dump(content) for path, content in data.items()}


def gpus(world: World, *, drained: str = "", **count: int) -> Files:
    """Return the inventory file with these numbers of GPUs by node, and one node drained."""
    inventory = yaml.safe_load(world.file(NODES))
    for node in inventory["nodes"]:
        if node["id"] in count:
            node |= {"capabilities": ["gpu"], "capacity": {"gpu": count[node["id"]]}}
        node["drained"] = node["id"] == drained
    return {NODES: yaml.safe_dump(inventory)}
