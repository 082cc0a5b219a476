"""An application gets a node that fits and keeps it, and every generator chooses the same node.

``tests/scenarios`` has stories of it.
"""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any

from demandops.base.errors import Refused
from demandops.decide.decision import Decision
from demandops.model.config.inventory import Node
from demandops.model.config.load import load
from hypothesis import given

from tests.kit.chance import chances, examples
from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo
from tests.scenarios.running import configuration

SOURCES = ("vehicle0", "vehicle1")
CAPABILITIES = ("gpu", "lidar")


def repo_with(nodes: list[dict[str, Any]], **config: dict[str, Any]) -> MemoryRepo:
    """Return a repo with only these nodes, and with further files of the configuration."""
    files: dict[str, dict[str, Any]] = {
        "inventory/nodes.yaml": {
            "nodes": [{"cluster": "c-its", "type": "edge"} | n for n in nodes]
        },
        "inventory/brokers.yaml": {"brokers": [{"node": SOURCES[0], "host": "any"}]},
        "policy/access-domains.yaml": {"domains": [{"name": "all", "namespace": "all"}]},
    }
    return MemoryRepo(state=state_of(load(configuration(config=files | config))))


def asking(place: dict[str, Any], id: str = "app", demand: str = "d", **more: Any) -> Any:
    inputs = {"ego_data": [{"topic": "/ego", "source": SOURCES[0]}]}
    app = {"id": id, "type": "object-detection-fusion", "place": place, "inputs": inputs} | more
    return {"kind": "Demand", "demand": demand, "requesters": ["v"], "applications": [app]}


def chance(random: Random) -> MemoryRepo:
    """Return a random repo in which a quota, a missing broker or a rule may forbid a node."""

    def somewhere() -> dict[str, Any]:
        where = {"position": {"x": random.randrange(4), "y": random.randrange(4)}}
        return where if random.random() < 0.6 else {}

    nodes = [{"id": id, "type": "vehicle"} | somewhere() for id in SOURCES]
    ids = [f"node{number}" for number in range(random.randint(1, 6))]
    nodes += [
        {
            "id": id,
            "type": random.choice(("edge", "edge", "cloud")),
            "selector": {"zone": random.choice("ab")},
            "capabilities": [one for one in CAPABILITIES if random.random() < 0.6],
            "drained": random.random() < 0.15,
        }
        | somewhere()
        for id in ids
    ]
    other = [id for id in ids if random.random() < 0.4] or ["none"]
    peers = random.choice([[], ["*"]])
    domains: list[dict[str, Any]] = [
        {"name": name, "namespace": name, "rules": [{"name": "all", "peers": [*peers]}]}
        for name in ("first", "other")
    ]
    domains[0]["nodes"] = [*SOURCES, *(id for id in ids if id not in other)]
    domains[0]["quotas"] = {"servicesPerNode": random.randint(1, 2)}
    domains[1]["nodes"] = other
    brokers = [{"node": id, "host": id} for id in ids if random.random() < 0.6]
    config = {"policy/access-domains.yaml": {"domains": domains}}
    config |= {"inventory/brokers.yaml": {"brokers": brokers}} if brokers else {}
    return repo_with(nodes, **config)


def requirement(random: Random) -> dict[str, Any]:
    return {
        "role": random.choice(("edge", "edge", "cloud")),
        "labels": [f"zone={random.choice('ab')}"] if random.random() < 0.3 else [],
        "capabilities": [one for one in CAPABILITIES if random.random() < 0.2],
    }


def has(node: Node, place: dict[str, Any]) -> bool:
    labels = {f"{key}={value}" for key, value in node.labels.items()}
    return (
        node.type == place["role"]
        and {*place["labels"]} <= labels
        and {*place["capabilities"]} <= {*node.capabilities}
    )


def shuffled(repo: MemoryRepo, random: Random) -> MemoryRepo:
    twin, nodes = repo.copy(), list(repo.config.nodes.items())
    random.shuffle(nodes)
    twin.state = state_of(replace(repo.config, nodes=dict(nodes)), repo.state.ledger)
    return twin


@examples(30)
@given(chances)
def test_it_is_a_node_that_fits_the_same_in_any_order_and_stays(random: Random) -> None:
    repo = chance(random)
    for number in range(5):
        place, id = requirement(random), random.choice("xyz")
        role, source = random.choice(["ego_data", "point_cloud"]), random.choice(SOURCES)
        inputs = {role: [{"topic": "/t", "source": source}]}
        goal = asking(place, id, f"d{number}", inputs=inputs)
        (app,) = goal["applications"]
        held = repo.state.ledger.application(id)
        takes = {
            node
            for node, one in repo.config.nodes.items()
            if has(one, place) and (not one.drained or (held and held.node == node))
            if isinstance(
                repo.copy().take(goal | {"applications": [app | {"node": node}]}), Decision
            )
        }
        twin = shuffled(repo, random)
        taken, same = repo.take(goal), twin.take(goal)
        assert twin.files == repo.files, "another generator must decide the same"
        assert isinstance(taken, Decision) is bool(takes), str(taken)
        if isinstance(taken, Refused):
            assert str(same) == str(taken)
            continue
        booked = repo.state.ledger.application(id)
        assert booked is not None and booked.node in takes
        weaker = goal | {"applications": [app | {"place": {"role": place["role"]}}]}
        assert isinstance(shuffled(repo, random).take(weaker), Decision)
        assert repo.send(weaker).state.ledger.application(id).node == booked.node
