"""An application has services on three nodes; only the needed topics are carried, each once.

Each vehicle has a driver, which all applications share. At the edge are a detection for each
driver, a fusion, and a planner. The plan is delivered to the vehicles.
"""

from __future__ import annotations

from pathlib import Path

import yaml
from demandops.base.naming import object_name
from demandops_ros import DemandClient

from tests.e2e.common.expected import WITHOUT_DEMANDS
from tests.e2e.common.namespace import Namespace, Pods, name_of, wait_for_pods
from tests.e2e.common.world import World

EXAMPLE = Path(__file__).parents[3] / "examples" / "lane-detection"
APPDEF = "appdefs/object-detection-fusion"
CHART = {"folder": "appdefs/lane-detection/charts/ros-launch", "version": "0.2.0"}
NODES = "inventory/nodes.yaml"
PLAN = "/edge_object_detection_fusion_plan"


def test_four_services_on_three_nodes_serve_two_vehicles(
    world: World, requester: DemandClient
) -> None:
    domain = world.domain
    world.push(definitions(world))
    at_first = domain.inventory() | {"HelmChart ros-launch-0.2.0"}  # from the next commit on
    put(world, requester, "vehicle00", "vehicle01")
    assert_exact(domain, "vehicle00", "vehicle01")
    before = domain.uids()

    put(world, requester, "vehicle00")
    assert_exact(domain, "vehicle00")
    after = domain.uids()
    assert after == {name: before[name] for name in after}, (
        "a pod that both demands need was restarted"
    )

    requester.release("trip")
    follow(world)
    domain.wait_lines(WITHOUT_DEMANDS)
    domain.wait_inventory(at_first)


def definitions(world: World) -> dict[str, str | None]:
    """Return the example's appdefs with a planner added, and registry and nodes that fit them."""
    files = {
        path.relative_to(EXAMPLE).as_posix(): path.read_text()
        for path in (EXAMPLE / "appdefs").rglob("*")
        if path.is_file()
    }
    appdef = yaml.safe_load(files[f"{APPDEF}/appdef.yaml"])
    appdef["services"]["planner"] = {
        "prefix": "plan",
        "inputs": {"objects": "object-fusion.fused_objects"},
        "outputs": {"plan": "/{instance}_plan"},
        "chart": "ros-launch",
        "images": ["planner"],
        "values": "values/planner.yaml.j2",
    }
    charts = yaml.safe_load(world.file("registry/charts.yaml"))
    charts["charts"]["ros-launch"] = CHART
    images = yaml.safe_load(world.file("registry/images.yaml"))
    for name in ("lidar-driver", "lane-detection", "planner"):
        images["images"][name] = {"repository": f"registry.example/{name}", "tag": "1.0.0"}
    nodes = yaml.safe_load(world.file(NODES))
    for node in nodes["nodes"]:
        if node["type"] == "vehicle":
            node["topics"]["point_cloud"] = cloud(node["id"])
    return {
        **files,
        f"{APPDEF}/appdef.yaml": yaml.safe_dump(appdef),
        f"{APPDEF}/values/planner.yaml.j2": (
            Path(__file__).with_name("planner.yaml.j2")
        ).read_text(),
        "registry/charts.yaml": yaml.safe_dump(charts),
        "registry/images.yaml": yaml.safe_dump(images),
        NODES: yaml.safe_dump(nodes),
    }


def cloud(vehicle: str) -> str:
    return f"/vehicles/{vehicle}/drivers/lidar/pointcloud"


def ego_data(vehicle: str) -> str:
    return f"/vehicles/{vehicle}/ego_data"


def put(world: World, requester: DemandClient, *vehicles: str) -> None:
    """Demand the application for these vehicles; its output `planner.plan` is delivered to each."""
    application = {
        "id": "edge/object_detection_fusion",
        "type": "object-detection-fusion",
        "node": "edge",
        "inputs": {
            "ego_data": [{"topic": ego_data(each), "source": each} for each in vehicles],
            "point_cloud": [{"topic": cloud(each), "source": each} for each in vehicles],
        },
        "deliver": [{"output": "planner.plan", "node": each} for each in vehicles],
    }
    assert requester.put("trip", [application]).warnings == ()
    follow(world)


def follow(world: World) -> None:
    world.domain.wake()
    world.domain.wait_applied(world.tip())


def assert_exact(domain: Namespace, *vehicles: str) -> None:
    """Wait until exactly the pods for these vehicles run on their nodes, then check all flows."""
    pods: Pods = {(f"{name}-edge-object-detection-fusion", "edge") for name in ("of", "plan")}
    flows = []
    for vehicle in vehicles:
        pods |= {(f"lidar-{vehicle}-{vehicle}", vehicle), (f"od-edge-{vehicle}", "edge")}
        here = [(vehicle, topic, "edge") for topic in (f"/{vehicle}_points", ego_data(vehicle))]
        here.append(("edge", PLAN, vehicle))
        for source, topic, target in here:
            id = f"derived/{source}/{target}{topic}"
            pods |= {
                (object_name("mqtt", id, side), end)
                for side, end in (("source", source), ("target", target))
            }
        flows += here
    wait_for_pods({domain: pods})
    domain.wait_releases()
    assert domain.pods() == pods, "the namespace changed again"
    assert carried(domain) == sorted(flows)


def carried(domain: Namespace) -> list[tuple[str, str, str]]:
    """Return each carried topic as its source node, its name and its target node, sorted."""
    sent, received = [], []  # also with broker and MQTT topic, which must be equal at both ends
    for config in domain.find("ConfigMap"):
        if "params.yaml" in config["data"]:
            (found,) = yaml.safe_load(config["data"]["params.yaml"]).values()
            broker, bridge = (found["ros__parameters"][part] for part in ("broker", "bridge"))
            (pod,) = domain.find("Pod", name_of(config))
            node = pod["spec"]["nodeSelector"]["node_id"]
            out, back = bridge.get("ros2mqtt", {}), bridge.get("mqtt2ros", {})
            for topic in out.get("ros_topics", ()):
                sent.append((topic, str(broker), out[topic]["mqtt_topic"], node))
            for place in back.get("mqtt_topics", ()):
                received.append((back[place]["ros_topic"], str(broker), place, node))
    assert sorted(end[:3] for end in sent) == sorted(end[:3] for end in received)
    return sorted((s[3], s[0], r[3]) for s in sent for r in received if s[:3] == r[:3])
