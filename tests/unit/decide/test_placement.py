"""An application gets a node that fits and keeps it, and every generator chooses the same node."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from random import Random
from typing import Any

import pytest
import yaml
from demandops.decide.booking import put as book
from demandops.decide.decision import Decision
from demandops.decide.placement.capacity import Usage
from demandops.decide.placement.placement import with_chosen_nodes
from demandops.model.config.config import Config
from demandops.model.config.inventory import Node, Position
from demandops.model.config.load import load
from demandops.model.config.policy import AccessDomain, Rule
from demandops.model.demand.claim import Application, InputTopic, Requirement
from demandops.model.demand.demand_request import Demanded, Put
from demandops.model.ledger.ledger import Ledger, World
from demandops.repo.history import commit_message
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.config import skeleton, state_of
from tests.kit.memory import NOW, MemoryRepo
from tests.scenarios.running import configuration

CONFIG = MemoryRepo().config
ROLES, LABELS, CAPABILITIES = ("edge", "cloud"), ("", "a", "b"), ("gpu", "lidar")
SOURCES = ("vehicle0", "vehicle1")


def chance(random: Random) -> Config:
    """Return a random configuration; only the requester 'operator' may use the domain 'closed'."""

    def position() -> Position | None:
        if random.random() < 0.4:
            return None
        return Position(x=random.randrange(4), y=random.randrange(4))

    ids = [f"node{number}" for number in range(random.randrange(1, 9))]
    nodes = [
        Node(
            id=id,
            type=random.choice(ROLES),
            cluster="c-its",
            selector={"zone": random.choice(LABELS)},
            capabilities=tuple(c for c in CAPABILITIES if random.random() < 0.5),
            position=position(),
            drained=random.random() < 0.2,
        )
        for id in ids
    ]
    nodes += [Node(id=id, type="vehicle", cluster="c-its", position=position()) for id in SOURCES]
    rule = Rule(name="operators", requesters=("operator",))
    domains = [
        AccessDomain(name="open", namespace="open"),
        AccessDomain(name="closed", namespace="closed", rules=(rule,)),
        None,
    ]
    domain_of = {n.id: d for n in nodes if (d := random.choices(domains, (6, 1, 1))[0])}
    return replace(CONFIG, nodes={node.id: node for node in nodes}, domain_of=domain_of)


def shuffled(config: Config, random: Random) -> Config:
    nodes = list(config.nodes.items())
    random.shuffle(nodes)
    return replace(config, nodes=dict(nodes))


def demand(random: Random, demand: str = "d", application: str = "app") -> Put:
    sources = random.sample(SOURCES, random.randrange(1, 3))
    app = Application(
        id=application,
        appdef="object-detection-fusion",
        node="",
        inputs={"ego_data": tuple(InputTopic("/ego", source) for source in sources)},
        place=Requirement(
            role=random.choice(("", *ROLES)),
            labels=(("zone", random.choice(LABELS)),) if random.random() < 0.4 else (),
            capabilities=tuple(c for c in CAPABILITIES if random.random() < 0.3),
        ),
    )
    one = Demanded(app, ("vehicle0",), "applications[0].{}".format)
    return Put(id=demand, demand=demand, own_requesters=("vehicle0",), demanded=(one,))


def required(request: Put) -> Requirement:
    held = request.demanded[0].held
    assert isinstance(held, Application) and held.place is not None
    return held.place


def asking_for(request: Put, requirement: Requirement) -> Put:
    held = request.demanded[0].held
    assert isinstance(held, Application)
    one = replace(request.demanded[0], held=replace(held, place=requirement))
    return replace(request, demanded=(one,))


def chosen(request: Put, ledger: Ledger, config: Config) -> tuple[str, Put, list[str]]:
    world = World(config, ledger)
    placed, faults = with_chosen_nodes(request, world, Usage(), None, lambda: None)
    (one,) = placed.demanded
    assert isinstance(one.held, Application) and isinstance(placed, Put)
    assert bool(one.held.node) != bool(faults)
    return one.held.node, placed, [str(fault) for fault in faults]


def has(node: Node, requirement: Requirement) -> bool:
    return (
        requirement.role in ("", node.type)
        and all(node.labels().get(key) == value for key, value in requirement.labels)
        and {*requirement.capabilities} <= {*node.capabilities}
    )


@examples(60)
@given(st.randoms(use_true_random=False))
def test_it_is_a_node_that_fits_the_same_in_any_order_and_stays(random: Random) -> None:
    config, ledger, others = chance(random), Ledger(), Counter[str]()
    for number in range(random.randrange(4)):
        request = demand(random, f"other{number}", f"other{number}")
        node, placed, _ = chosen(request, ledger, config)
        if node:
            ledger, _ = book(ledger, placed, NOW)
            others[node] += 1
    assert dict(ledger.applications_on) == others
    request = demand(random)
    requirement = required(request)
    node, placed, faults = chosen(request, ledger, config)
    assert chosen(request, ledger, shuffled(config, random))[::2] == (node, faults)
    fitting = [
        one
        for one in config.nodes.values()
        if has(one, requirement)
        and not one.drained
        and one.id in config.domain_of
        and config.domain_of[one.id].name == "open"
    ]
    if not node:
        assert fitting == []
        return
    assert config.nodes[node] in fitting
    ledger, _ = book(ledger, placed, NOW)
    later = asking_for(request, Requirement(role=config.nodes[node].type))
    assert chosen(later, ledger, shuffled(config, random))[0] == node
    joining = demand(random, "joins")
    wanted = required(joining)
    joined, _, faults = chosen(joining, ledger, config)
    assert joined == (node if has(config.nodes[node], wanted) else "")
    assert all("is held by vehicle0 on" in text for text in faults)


def inventory(**more: dict[str, Any]) -> dict[str, str]:
    """Return the skeleton's ``inventory/nodes.yaml``, with further fields of some nodes."""
    data = yaml.safe_load(skeleton()["inventory/nodes.yaml"])
    data["nodes"] = [node | more.get(node["id"], {}) for node in data["nodes"]]
    return {"inventory/nodes.yaml": json.dumps(data)}


def asking(*items: dict[str, Any], demand: str = "d", **more: Any) -> dict[str, Any]:
    """Return a demand that lists one application for each ``place`` in ``items``."""
    apps = [
        {
            "id": f"{demand}{index}",
            "type": "object-detection-fusion",
            "place": place,
            "inputs": {"ego_data": [{"topic": "/ego", "source": "vehicle00"}]},
        }
        for index, place in enumerate(items)
    ]
    return {"kind": "Demand", "demand": demand, "requesters": ["v"], "applications": apps} | more


@pytest.mark.parametrize(
    ("place", "more", "says"),
    [
        ({"role": "edge"}, {}, "'edge', the only node that fits"),
        (
            {"capabilities": ["gpu"]},
            {},
            "'edge', the nearest to its sources among 2 nodes that fit",
        ),
        (
            {"capabilities": ["gpu"]},
            {"positions": [{"node": "cloud", "x": 3, "y": 4}]},
            "'cloud', the nearest to its sources among 2 nodes that fit",
        ),
        ({"role": "vehicle", "labels": ["node_id=vehicle00"]}, {}, "'vehicle00', the only node"),
    ],
)
def test_the_answer_and_the_commit_say_which_node_and_why(
    place: dict[str, Any], more: dict[str, Any], says: str
) -> None:
    repo = MemoryRepo(
        inventory(
            vehicle00={"position": {"x": 0, "y": 0}},
            edge={"capabilities": ["gpu"], "position": {"x": 30, "y": 40}},
            cloud={"capabilities": ["gpu"]},
        )
    )
    decision = repo.send(asking(place, **more))
    (placed,) = decision.placed
    assert placed.startswith(f"application 'd0' is placed on {says}")
    message = commit_message.of_decision(decision, "op", NOW)
    assert f" Application 'd0' is placed on {says}" in message
    again = repo.send(asking(place, **more))
    node = says.partition(",")[0]
    assert again.outcome == "unchanged"
    assert again.placed == (f"application 'd0' is placed on {node}, where it is booked already",)


def test_applications_of_one_demand_are_spread() -> None:
    repo = MemoryRepo(inventory(edge={"capabilities": ["gpu"]}, cloud={"capabilities": ["gpu"]}))
    gpu = {"capabilities": ["gpu"]}
    repo.send(asking(gpu, gpu))
    assert dict(repo.state.ledger.applications_on) == {"cloud": 1, "edge": 1}
    repo.send(asking(gpu))
    assert dict(repo.state.ledger.applications_on) == {"cloud": 1}


def test_the_middle_of_all_sources_decides() -> None:
    gpu, vehicles = {"capabilities": ["gpu"]}, [f"vehicle0{number}" for number in range(3)]
    places = {id: {"position": {"x": 100 * i, "y": 0}} for i, id in enumerate(vehicles)}
    places |= {"edge": gpu | {"position": {"x": 0, "y": 0}}}
    places |= {"cloud": gpu | {"position": {"x": 140, "y": 0}}}
    goal = asking(gpu)
    inputs = goal["applications"][0]["inputs"]
    repo = MemoryRepo(inventory(**places))
    assert "on 'edge', the nearest" in repo.decide(goal).placed[0]
    inputs["ego_data"] = [{"topic": "/ego", "source": id} for id in vehicles]
    assert "on 'cloud', the nearest" in repo.decide(goal).placed[0]


def with_limits(random: Random) -> MemoryRepo:
    """Return a random repo in which a quota, a missing broker or a rule may forbid a node."""
    edges = [f"edge{number}" for number in range(random.randint(1, 5))]
    ids = (*SOURCES, *edges)
    kinds = {id: "vehicle" if id in SOURCES else "edge" for id in ids}
    nodes = [{"id": id, "type": kinds[id], "cluster": "c-its"} for id in ids]
    other = [id for id in edges if random.random() < 0.4] or ["none"]
    peers = random.choice([[], ["*"]])
    domains: list[dict[str, Any]] = [
        {"name": name, "namespace": name, "rules": [{"name": "all", "peers": [*peers]}]}
        for name in ("first", "other")
    ]
    domains[0]["nodes"] = [id for id in ids if id not in other]
    domains[0]["quotas"] = {"servicesPerNode": random.randint(1, 2)}
    domains[1]["nodes"] = other
    brokers = [{"node": id, "host": id} for id in edges if random.random() < 0.6]
    files = {
        "inventory/nodes.yaml": {"nodes": nodes},
        "inventory/brokers.yaml": {"brokers": brokers or [{"node": SOURCES[0], "host": "any"}]},
        "policy/access-domains.yaml": {"domains": domains},
    }
    return MemoryRepo(state=state_of(load(configuration(config=files))))


@examples(8)
@given(st.randoms(use_true_random=False))
def test_a_demand_is_refused_only_if_each_node_that_fits_refuses_it(random: Random) -> None:
    repo = with_limits(random)
    edges = [id for id, node in repo.config.nodes.items() if node.type == "edge"]
    for number in range(5):
        goal = asking({"role": "edge"}, demand=f"d{number}")
        (app,) = goal["applications"]
        role, source = random.choice(["ego_data", "point_cloud"]), random.choice(SOURCES)
        app |= {"id": random.choice("xyz"), "inputs": {role: [{"topic": "/t", "source": source}]}}
        named = {
            id: repo.copy().take(goal | {"applications": [app | {"node": id}]}) for id in edges
        }
        takes = {id for id, taken in named.items() if isinstance(taken, Decision)}
        taken = repo.take(goal)
        assert isinstance(taken, Decision) is bool(takes), (str(taken), named)
        if isinstance(taken, Decision):
            booked = repo.state.ledger.application(app["id"])
            assert booked is not None and booked.node in takes
