"""One node in two access domains, each of which has its own namespace, account and ROS domain.

The edge is in the skeleton's domain and in a second one, of a city. The city's requesters may use
the edge only in the city's domain. In each domain an application on the edge detects objects in the
same topic of a vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import yaml
from demandops.base.naming import object_name
from demandops_ros import DemandClient

from tests.e2e.common.domain import Domain, wait_for_pods
from tests.e2e.common.expected import CLUSTER, NAMESPACE, WITHOUT_DEMANDS
from tests.e2e.common.goals import CLOUD, application
from tests.e2e.common.world import World
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Rig
from tests.kit.limits import PATIENCE_S

NODES, POLICY = "inventory/nodes.yaml", "policy/access-domains.yaml"
CITY, CITY_ROS = "city", 42
POINTS = ["vehicle00"]


def end(of: str, side: str, node: str) -> tuple[str, str]:
    """Return the client of the connection that carries the point cloud to the edge."""
    connection = f"derived/vehicle00/{of}{CLOUD.format('vehicle00')}"
    return object_name("mqtt", connection, side), node


FLEETS = {
    ("od-edge-vehicle00", "edge"),
    ("of-edge-fleet", "edge"),
    end("edge", "source", "vehicle00"),
    end("edge", "target", "edge"),
}
TO_THE_CITY = {end("edge@city", "source", "vehicle00")}  # runs in the vehicle's access domain
CITYS = {
    ("od-edge-city-vehicle00", "edge"),
    ("of-edge-lights", "edge"),
    end("edge@city", "target", "edge"),
}


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig, ros_domain: int) -> Iterator[World]:
    made = make_world()
    made.push(two_domains(made))
    made.generator.start()
    with DemandClient("vehicle00", domain_id=ros_domain, timeout_s=2 * PATIENCE_S) as first:
        first.put("first", [application("first", point_cloud=POINTS)])  # this applies the policy
        first.release("first")
    domains = made.lay_down(rig, made.manifests(CLUSTER))
    made.domains = {domain.namespace: domain for domain in domains}
    assert {*made.domains} == {NAMESPACE, CITY}
    for domain in domains:
        domain.settle(made.tip())
        domain.wait_lines(WITHOUT_DEMANDS)
    yield made
    made.remove()  # while its namespaces still exist
    rig.kube.delete("Namespace", CITY)


@pytest.fixture
def traffic(ros_domain: int) -> Iterator[DemandClient]:
    with DemandClient("traffic", domain_id=ros_domain, timeout_s=2 * PATIENCE_S) as made:
        yield made


def test_two_domains_share_a_machine_and_nothing_else(
    world: World, requester: DemandClient, traffic: DemandClient
) -> None:
    fleet, city = world.domains[NAMESPACE], world.domains[CITY]
    requester.put("fleet", [application("edge/fleet", point_cloud=POINTS)])
    wait_for_pods({fleet: FLEETS, city: set()})
    before = fleet.uids()

    traffic.put("lights", [application("edge/lights", point_cloud=POINTS)])
    wait_for_pods({fleet: FLEETS | TO_THE_CITY, city: CITYS})
    assert before.items() <= fleet.uids().items(), "a pod of the first domain was restarted"
    assert ros_domains(city) == {CITY_ROS}
    assert ros_domains(fleet) == {0}
    assert granted(fleet, of=fleet)
    assert granted(fleet, of=city) == granted(city, of=fleet) == set()

    requester.release("fleet")
    wait_for_pods({fleet: TO_THE_CITY, city: CITYS})
    traffic.release("lights")
    for domain in (fleet, city):
        domain.wake()
        domain.wait_lines(WITHOUT_DEMANDS)


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


def granted(where: Domain, *, of: Domain) -> set[str]:
    """Return what domain `of`'s account may use elsewhere; each account may ask for its rights."""
    rules = where.kube.rules("demandops", where.namespace, of.namespace)
    asked = {"authorization.k8s.io", "authentication.k8s.io"}
    return {one for rule in rules if {*rule["apiGroups"]} - asked for one in rule["resources"]}


def ros_domains(domain: Domain) -> set[int]:
    return {
        int(variable["value"])
        for deployment in domain.find("Deployment")
        for container in deployment["spec"]["template"]["spec"]["containers"]
        for variable in container.get("env", ())
        if variable["name"] == "ROS_DOMAIN_ID"
    }
