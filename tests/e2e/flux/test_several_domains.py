"""One node in two access domains, each of which has its own namespace, account and ROS domain.

The edge is in the skeleton's domain and in a second one, of a city. The city's requesters may use
the edge only in the city's domain. In each domain an application on the edge detects objects in the
same topic of a vehicle.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from demandops_ros import DemandClient

from tests.e2e.common.expected import CLUSTER, NAMESPACE, WITHOUT_DEMANDS
from tests.e2e.common.namespace import name_of
from tests.e2e.rig.cluster import Rig

from .conftest import MakeWorld
from .view import Domain
from .world import World

NODES, POLICY = "inventory/nodes.yaml", "policy/access-domains.yaml"
CITY, CITY_ROS = "city", 42
CLOUD = "/vehicles/vehicle00/drivers/lidar/pointcloud"
_POD = re.compile(r"pod of (?P<name>\S+?)(-[0-9a-f]{12})? on (?P<node>\S+), ready")

FLEETS = {
    ("od-edge-vehicle00", "edge"),
    ("of-edge-fleet", "edge"),
    ("mqtt-derived-vehicle00-edge-source", "vehicle00"),
    ("mqtt-derived-vehicle00-edge-target", "edge"),
}
TO_THE_CITY = {("mqtt-derived-vehicle00-edge-city-source", "vehicle00")}
"""The source end of the connection to the city; it runs in the access domain of the vehicle."""
CITYS = {
    ("od-edge-city-vehicle00", "edge"),
    ("of-edge-lights", "edge"),
    ("mqtt-derived-vehicle00-edge-city-target", "edge"),
}


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig, ros_domain: int) -> Iterator[World]:
    """A state repo with two access domains and no demand, which the cluster follows."""
    made = make_world()
    made.push(two_domains(made))
    made.generator.start()
    with DemandClient("vehicle00", domain_id=ros_domain, timeout_s=120) as first:
        first.put("first", [application("first")])  # its commit applies the policy
        first.release("first")
    manifests = list(yaml.safe_load_all(made.file(f"bootstrap/{CLUSTER}.yaml")))
    made.apply(rig.kube, manifests)
    for item in manifests:
        if item["kind"] == "Kustomization":
            namespace = item["metadata"]["namespace"]
            made.domains[namespace] = Domain(rig.kube, namespace, item["metadata"]["name"])
    assert {*made.domains} == {NAMESPACE, CITY}
    for domain in made.domains.values():
        domain.wait_applied(made.tip())
        for chart in domain.find("HelmChart"):
            rig.kube.wait_ready("HelmChart", name_of(chart), domain.namespace)
        domain.wait_lines(WITHOUT_DEMANDS)
    yield made
    made.remove()  # while its namespaces still exist
    rig.kube.delete("Namespace", CITY)


@pytest.fixture
def traffic(ros_domain: int) -> Iterator[DemandClient]:
    with DemandClient("traffic", domain_id=ros_domain, timeout_s=120) as made:
        yield made


def test_two_domains_share_a_machine_and_nothing_else(
    world: World, requester: DemandClient, traffic: DemandClient
) -> None:
    fleet, city = world.domains[NAMESPACE], world.domains[CITY]
    assert requester.put("fleet", [application("edge/fleet")]).outcome == "booked"
    wait_for({fleet: FLEETS, city: set()})
    before = fleet.uids()

    assert traffic.put("lights", [application("edge/lights")]).outcome == "booked"
    wait_for({fleet: FLEETS | TO_THE_CITY, city: CITYS})
    assert {name: fleet.uids()[name] for name in before} == before, (
        "a pod of the first domain was restarted"
    )
    assert ros_domains(city) == {CITY_ROS}
    assert ros_domains(fleet) == {0}
    assert granted(fleet, of=fleet)
    assert granted(fleet, of=city) == granted(city, of=fleet) == set()

    requester.release("fleet")
    wait_for({fleet: TO_THE_CITY, city: CITYS})
    traffic.release("lights")
    for domain in (fleet, city):
        domain.wake()
        domain.wait_lines(WITHOUT_DEMANDS)


def application(id: str) -> dict[str, Any]:
    """Return an application on the edge; the rules for the requester decide the access domain."""
    inputs = {"point_cloud": [{"topic": CLOUD, "source": "vehicle00"}]}
    return {"id": id, "type": "object-detection-fusion", "node": "edge", "inputs": inputs}


def two_domains(world: World) -> dict[str, str]:
    """Return the skeleton's policy and inventory files, with the edge in a second domain too."""
    policy, inventory = (yaml.safe_load(world.file(path)) for path in (POLICY, NODES))
    (first,) = policy["domains"]
    second = first | {
        "name": CITY,
        "namespace": CITY,
        "nodes": ["no-node-of-its-own"],
        "ros": {"domainId": CITY_ROS},
        "rules": [{"name": "traffic", "requesters": ["traffic"], "peers": [first["name"]]}],
    }
    first["rules"] = [
        {"name": "fleet", "requesters": ["vehicle*"]},
        {"name": "data", "requesters": ["traffic"], "nodes": ["vehicle*"], "peers": [CITY]},
    ]
    policy["domains"].append(second)
    for node in inventory["nodes"]:
        if node["id"] == "edge":
            node["accessDomains"] = [{"name": CITY}]
    return {POLICY: yaml.safe_dump(policy), NODES: yaml.safe_dump(inventory)}


def wait_for(wanted: dict[Domain, set[tuple[str, str]]]) -> None:
    """Wait until each domain runs exactly its pods, given as pairs of a name and a node."""

    def same() -> bool:
        for domain in wanted:
            domain.wake()
        return all(running(domain) == pods for domain, pods in wanted.items())

    kube = next(iter(wanted)).kube
    listed = {domain.namespace: sorted(pods) for domain, pods in wanted.items()}
    kube.wait(f"exactly {listed}", same, 120.0)


def running(domain: Domain) -> set[tuple[str, str]]:
    """Return each ready pod's name without the hash, and its node; '?' if a pod is not ready."""
    lines = (line for line in domain.lines() if line.startswith("pod of "))
    matches = map(_POD.fullmatch, lines)
    return {(match["name"], match["node"]) if match else ("?", "?") for match in matches}


def granted(where: Domain, *, of: Domain) -> set[str]:
    """Return the resources that the account of domain `of` may use in the namespace of `where`.

    The resources by which an account asks for its own rights are left out, because every account
    may use them.
    """
    rules = where.kube.rules("demandops", where.namespace, of.namespace)
    asked = {"authorization.k8s.io", "authentication.k8s.io"}
    return {one for rule in rules if {*rule["apiGroups"]} - asked for one in rule["resources"]}


def ros_domains(domain: Domain) -> set[int]:
    """Return the ROS domains of all containers in an access domain."""
    containers = [
        container
        for deployment in domain.find("Deployment")
        for container in deployment["spec"]["template"]["spec"]["containers"]
    ]
    return {
        int(variable["value"])
        for container in containers
        for variable in container.get("env", ())
        if variable["name"] == "ROS_DOMAIN_ID"
    }
