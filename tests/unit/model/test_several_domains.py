"""A node in several access domains has a policy, a namespace and a ROS domain in each."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.decide.planning.release_keys import ServiceKey

from tests.kit.config import skeleton
from tests.kit.goals import application, connection, goal, put
from tests.kit.memory import NOW, MemoryRepo, ledger_in

FLEET = {
    "name": "fleet",
    "namespace": "fleet",
    "nodes": ["vehicle*", "edge"],
    "rules": [{"name": "fleet", "requesters": ["vehicle*", "both"], "peers": ["city"]}],
}
CITY = {
    "name": "city",
    "namespace": "city",
    "nodes": ["station*", "cloud"],
    "ros": {"domainId": 42},
    "podSecurity": "privileged",
    "rules": [{"name": "city", "requesters": ["city*", "both"], "nodes": ["edge"]}],
    "quotas": {"servicesPerNode": 2},
    "leases": {"default": "10m"},
    "brokerCredentials": {"edge": {"secret": "mqtt-of-the-city"}},
}
CITY_WITH_PEERS = {**CITY, "rules": [{"name": "city", "peers": ["fleet"]}]}


def files(further: Any, *domains: Any) -> dict[str, str]:
    nodes = yaml.safe_load(skeleton()["inventory/nodes.yaml"])
    for node in nodes["nodes"]:
        if node["id"] == "edge":
            node["accessDomains"] = further
    head = {"apiVersion": "demandops/v1", "kind": "AccessDomains"}
    policy = head | {"domains": domains or (FLEET, CITY)}
    return {
        "inventory/nodes.yaml": yaml.safe_dump(nodes),
        "policy/access-domains.yaml": yaml.safe_dump(policy),
    }


SEVERAL = files([{"name": "city"}])
FREE = files([{"name": "city"}], FLEET, CITY_WITH_PEERS)


def folders(repo: MemoryRepo) -> set[str]:
    return {path.split("/")[2] for path in repo.rendered()}


def fusion(demand: str, *who: str, node: str = "edge") -> dict[str, Any]:
    return put(demand, *who, node=node, connect="none")


def test_all_of_a_service_follows_the_domain() -> None:
    repo = MemoryRepo(SEVERAL)
    decision = repo.send(fusion("d", "city1"))
    assert folders(repo) == {"city"}
    assert decision.lease_s == 600
    (release,) = repo.objects("HelmRelease").values()
    values = release["spec"]["values"]
    assert release["metadata"]["namespace"] == "city"
    assert values["ros"]["domainId"] == 42
    assert values["nodeSelector"] == {"node_id": "edge"}
    assert repo.bookkeeping()["services"][release["metadata"]["name"]]["node"] == "edge@city"
    for number in range(2):
        made = fusion(f"d{number}", "city1")
        made["applications"][0]["id"] = f"edge/d{number}"
        taken = repo.take(made)
    assert "servicesPerNode" in str(taken), "the city's quota must refuse it"
    assert repo.send(fusion("of-the-fleet", "vehicle00")).outcome == "booked"
    rule = [d for d in yaml.safe_load_all(repo.files["bootstrap/c-its.yaml"]) if d]
    (policy,) = (
        d
        for d in rule
        if d["kind"] == "ValidatingAdmissionPolicy" and d["metadata"]["name"] == "demandops-city"
    )
    assert '["edge"]' in policy["spec"]["validations"][0]["expression"]


def test_services_of_two_domains_are_never_shared_and_stop_apart() -> None:
    repo = MemoryRepo(FREE)
    inputs = {"point_cloud": [{"topic": "/points", "source": "edge"}]}
    for demand, node in (("a", "edge@fleet"), ("b", "edge@city")):
        made = fusion(demand, "both" if node == "edge@fleet" else "city1", node=node)
        made["applications"][0]["inputs"] = inputs
        repo.send(made)
    keys = [key for key in repo.state.plans if isinstance(key, ServiceKey)]
    assert sorted((key.service, key.node) for key in keys) == [
        ("object-detection", "edge"),
        ("object-detection", "edge@city"),
        ("object-fusion", "edge"),
        ("object-fusion", "edge@city"),
    ]
    repo.send({"kind": "Demand", "operation": "release", "demand": "a", "requesters": ["both"]})
    assert folders(repo) == {"city"}
    assert ledger_in(repo.files) == repo.state.ledger


def test_the_capacity_of_a_machine_is_one_for_all_its_domains() -> None:
    appdef = "appdefs/object-detection-fusion/appdef.yaml"
    needing = skeleton()[appdef].replace("prefix: of\n", "prefix: of\n    requests: {cpu: 600m}\n")
    nodes = yaml.safe_load(FREE["inventory/nodes.yaml"])
    (edge,) = (node for node in nodes["nodes"] if node["id"] == "edge")
    edge["capacity"] = {"cpu": "1"}
    repo = MemoryRepo(FREE | {appdef: needing, "inventory/nodes.yaml": yaml.safe_dump(nodes)})
    repo.send(fusion("a", "both", node="edge@city"))
    assert repo.faults(fusion("b", "both", node="edge@fleet")) == [
        ": 'edge' has 0.4 of 1 cpu free, but 0.6 is asked for; choose another node, release "
        "something first, or ask for a change of inventory/nodes.yaml"
    ]
    made = fusion("b", "both", node="")
    made["applications"][0]["place"] = {"role": "edge"}
    assert "0.4 of 1 cpu free" in repo.faults(made)[0]


def test_data_crosses_only_by_a_connection_that_both_allow() -> None:
    demanded = put("d", "both", node="edge@city")
    refused = MemoryRepo(SEVERAL).faults(demanded)
    assert refused == [
        "requesters[0]: rule 'city' of access domain 'city' does not let 'both' connect the "
        "domain's nodes to nodes of 'fleet' (peers); request what is allowed, or ask for a change "
        "of policy/"
    ]
    repo = MemoryRepo(FREE)
    repo.send(demanded)
    assert list(repo.books()["connections"]) == ["derived/vehicle00/edge@city"]
    (target,) = (
        text for path, text in repo.rendered().items() if "/city/" in path and "target" in path
    )
    assert "mqtt-of-the-city" in target
    assert 'value: "42"' in target
    made = put("own", "both", node="edge@city", topic=("/ego", "edge"))
    repo.send(made)
    assert "derived/edge/edge@city" in repo.books()["connections"]


def test_the_reference_names_it_or_gets_it_by_a_rule() -> None:
    repo = MemoryRepo(FREE | {"policy/access-domains.yaml": SEVERAL["policy/access-domains.yaml"]})
    sent = goal([application(who=["city1"], ego=[], clouds=[("/points", "edge")])])
    repo.send(sent)
    assert folders(repo) == {"city"}
    assert repo.send(sent | {"shutdown": True}).outcome == "released"
    unclear = goal([application(who=["both"], clouds=[("/points", "edge")])])
    assert [fault.partition(":")[0] for fault in repo.faults(unclear)] == ["apps[0].header.node_id"]
    named = goal([application(who=["both"], node="edge@city", clouds=[("/points", "edge")])])
    assert repo.send(named).outcome == "booked"


def test_a_booked_application_stays_in_its_domain() -> None:
    repo = MemoryRepo(SEVERAL)
    repo.send(fusion("d", "both", node="edge@city"))
    assert repo.send(fusion("d", "both")).outcome == "unchanged"
    link = goal([], [connection("c", who=["both"], ends=("vehicle00", "edge"), broker="")])
    assert "name it as edge@fleet or edge@city" in repo.faults(link)[0]


def test_a_node_that_leaves_leaves_all_its_domains() -> None:
    repo = MemoryRepo(FREE)
    repo.send(fusion("a", "both", node="edge@city"))
    repo.send(fusion("b", "vehicle00", node="edge@fleet"))
    repo.send({"kind": "Decommission", "name": "edge", "as": ["node"], "by": "petra <p@x>"}, NOW)
    assert len(repo.state.ledger) == 0


@pytest.mark.parametrize(
    ("further", "domains", "fault"),
    [
        (
            [{"name": "town"}],
            (FLEET, CITY),
            "accessDomains[0].name: 'town' is not in policy/access-domains.yaml; known: city, "
            "fleet",
        ),
        (
            [{"name": "fleet"}],
            (FLEET, CITY),
            "accessDomains[0].name: 'edge' is already in 'fleet'; remove this entry",
        ),
        (
            [{"name": "city"}, {"name": "city"}],
            (FLEET, CITY),
            "accessDomains[1].name: 'edge' is already in 'city'; remove this entry",
        ),
        (
            [{"name": "city"}],
            ({**FLEET, "nodes": ["vehicle*"]}, CITY),
            "accessDomains[0]: no access domain has 'edge' in its nodes; add it to one",
        ),
        (
            [{"name": "city"}],
            (FLEET, {**CITY, "ros": {"domainId": 0}}),
            "accessDomains[0].name: access domains 'fleet' and 'city' share ROS domain 0, so each "
            "would read the other's topics on 'edge'; give one of them 'ros: {domainId: …}' in "
            "policy/access-domains.yaml",
        ),
    ],
)
def test_a_domain_that_does_not_fit_is_a_fault(
    further: Any, domains: tuple[Any, ...], fault: str
) -> None:
    with pytest.raises(InvalidInput) as raised:
        MemoryRepo(files(further, *domains))
    assert fault in str(raised.value)


@pytest.mark.parametrize(
    "domains",
    [(FLEET, {**CITY, "nodes": ["edge"]}), ({**FLEET, "serviceAccount": 1}, CITY)],
    ids=["the node is in two domains", "the node's domain is not valid"],
)
def test_a_fault_of_the_domains_is_not_told_as_one_of_the_node(domains: tuple[Any, ...]) -> None:
    moved = (
        "{apiVersion: demandops/v1, kind: Override, reason: r, owner: o, node: edge, "
        "select: [{nodes: [cloud]}]}\n"
    )
    with pytest.raises(InvalidInput) as raised:
        MemoryRepo(files([{"name": "city"}], *domains) | {"overrides/a.yaml": moved})
    assert "no access domain has" not in str(raised.value)
    assert "is not in any access domain" not in str(raised.value)


def test_no_node_has_the_id_that_another_node_gets_in_a_further_domain() -> None:
    taken = {"id": "edge@city", "type": "edge", "cluster": "c-its", "selector": {"host": "other"}}
    given = files([{"name": "city"}])
    nodes = yaml.safe_load(given["inventory/nodes.yaml"])
    nodes["nodes"].append(taken)
    with pytest.raises(InvalidInput) as raised:
        MemoryRepo(given | {"inventory/nodes.yaml": yaml.safe_dump(nodes)})
    assert (
        "accessDomains[0].name: a node of the inventory has the id 'edge@city'; rename that node"
    ) in str(raised.value)
