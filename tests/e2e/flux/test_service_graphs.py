"""An application has services on three nodes; only the needed topics are carried, each once.

Each vehicle has a driver, which all applications share. At the edge are a detection for each
driver, a fusion, and a planner. The plan is delivered to the vehicles.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import yaml
from demandops_ros import DemandClient

from tests.e2e.common.expected import FUSION, WITHOUT_DEMANDS
from tests.e2e.common.namespace import Namespace, name_of

from .world import World

EXAMPLE = Path(__file__).parents[3] / "examples" / "lane-detection"
APPDEF = "appdefs/object-detection-fusion"
CHART = {"folder": "appdefs/lane-detection/charts/ros-launch", "version": "0.2.0"}
NODES = "inventory/nodes.yaml"

PLANNER = "plan-edge-object-detection-fusion-440d666b5404"
FUSED = "/edge_object_detection_fusion_global_objectlist"
PLAN = "/edge_object_detection_fusion_plan"
SIDES = ("source", "target")
CLIENTS = {  # digests in the clients' names, by the nodes of their derived connection
    ("vehicle00", "edge"): ("749e95da341a", "62cce3e93c69"),
    ("vehicle01", "edge"): ("a6f86d82e5e2", "94affd7d6964"),
    ("edge", "vehicle00"): ("49db83c4f763", "c327804aa445"),
    ("edge", "vehicle01"): ("487346df7112", "aa8eb4a5f970"),
}


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
        f"{APPDEF}/values/planner.yaml.j2": PLANNER_VALUES,
        "registry/charts.yaml": yaml.safe_dump(charts),
        "registry/images.yaml": yaml.safe_dump(images),
        NODES: yaml.safe_dump(nodes),
    }


PLANNER_VALUES = """\
replicas: {{ replicas }}
image: {{ images["planner"] }}
nodeSelector: {{ node.selector }}
tolerations: {{ node.tolerations }}
hostNetwork: {{ node.host_network }}
launch:
  package: planner
  file: planner.launch.py
  arguments:
    objects_topic: {{ inputs.objects[0].topic }}
    plan_topic: {{ outputs.plan }}
"""


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
    """Wait until exactly the pods for these vehicles run on their nodes, then check all topics."""
    wanted = WITHOUT_DEMANDS | set(lines(*vehicles))
    domain.wait_lines(wanted)
    domain.wait_releases()
    assert domain.lines() == wanted, "the namespace changed again"
    assert carried(domain) == sorted(
        flow
        for vehicle in vehicles
        for flow in (
            (vehicle, f"/{vehicle}_points", "edge"),
            (vehicle, ego_data(vehicle), "edge"),
            ("edge", PLAN, vehicle),
        )
    )
    for vehicle in vehicles:
        points, objects = f"/{vehicle}_points", f"/{vehicle}_local_objectlist"
        assert topics(domain, f"lidar-{vehicle}-{vehicle}") == {cloud(vehicle), points}
        assert topics(domain, f"od-edge-{vehicle}") == {points, objects}
    assert FUSED in topics(domain, FUSION)
    assert topics(domain, PLANNER) == {FUSED, PLAN}


def lines(*vehicles: str) -> Iterator[str]:
    """Yield the lines that a demand for these vehicles adds to `Namespace.lines`."""
    yield from (f"ConfigMap {FUSION}-{part}" for part in ("params", "watcher"))
    services = [(FUSION, "edge"), (PLANNER, "edge")]
    clients = []
    for vehicle in vehicles:
        yield f"fusion takes {ego_data(vehicle)}"
        yield f"fusion takes /{vehicle}_local_objectlist"
        services += [(f"lidar-{vehicle}-{vehicle}", vehicle), (f"od-edge-{vehicle}", "edge")]
        for ends in ((vehicle, "edge"), ("edge", vehicle)):
            for node, side, digest in zip(ends, SIDES, CLIENTS[ends], strict=True):
                clients.append((f"mqtt-derived-{'-'.join(ends)}-{side}-{digest}", node))
    yield from (f"release {name}" for name, _ in services)
    yield from (f"ConfigMap {name}" for name, _ in clients)
    for name, node in services + clients:
        yield f"Deployment {name}"
        yield f"pod of {name} on {node}, ready"


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


def topics(domain: Namespace, service: str) -> set[str]:
    """Return the topics in the arguments of a service's pod."""
    (pod,) = domain.find("Pod", service)
    arguments = [arg for each in pod["spec"]["containers"] for arg in each.get("args", ())]
    return {arg.partition(":=")[2] for arg in arguments if "_topic:=" in arg}
