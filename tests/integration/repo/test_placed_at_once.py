"""Four generators place services at the same time: no node exceeds its capacity, and all agree."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import yaml
from demandops.base.errors import Refused
from demandops.repo import reader

from tests.kit import rig
from tests.kit.repo import read as file_of
from tests.kit.rig import Person

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
NODES = "inventory/nodes.yaml"
GPUS = {"edge": 2, "cloud": 1}
GENERATORS = 4


def with_gpus(bare: Path) -> dict[str, str | None]:
    """Return files in which each fusion needs one of three GPUs."""
    appdef, inventory = (yaml.safe_load(file_of(bare, path)) for path in (APPDEF, NODES))
    appdef["services"]["object-fusion"] |= {
        "place": {"capabilities": ["gpu"]},
        "requests": {"gpu": 1},
    }
    for node in inventory["nodes"]:
        if node["id"] in GPUS:
            node |= {"capabilities": ["gpu"], "capacity": {"gpu": GPUS[node["id"]]}}
    return {APPDEF: yaml.safe_dump(appdef), NODES: yaml.safe_dump(inventory)}


def put(demand: str, application: str, vehicle: str) -> dict[str, Any]:
    inputs = {"ego_data": [{"topic": f"/{vehicle}/ego", "source": vehicle}]}
    app = {"id": application, "type": "object-detection-fusion", "node": "station00"}
    app |= {"connect": "none", "inputs": inputs}
    head = {"kind": "Demand", "demand": demand, "requesters": [vehicle]}
    return head | {"applications": [app]}


def test_no_node_gets_more_than_it_has_and_who_shares_gets_one_node(
    url: str, bare: Path, person: Person, tmp_path: Path
) -> None:
    person.change(with_gpus(bare), "Fusions need a GPU")
    with ExitStack() as stack:
        generators = [
            stack.enter_context(rig.running(url, data=tmp_path / f"data-{number}"))
            for number in range(GENERATORS)
        ]
        goals = [put(f"d{n}", f"shared{n % 2}", f"vehicle0{n % 3}") for n in range(8)]
        goals += [put(f"e{n}", f"own{n}", "vehicle00") for n in range(4)]
        tickets = [generators[n % GENERATORS].submit(goal) for n, goal in enumerate(goals)]
        outcomes = Counter(outcome(ticket) for ticket in tickets)
    with reader.opened(str(bare)) as repo:
        ledger = repo.snapshot().state.ledger
    nodes: dict[str, set[str]] = {}
    for claim in ledger:
        nodes.setdefault(claim.subject.id, set()).add(claim.application.services["object-fusion"])
    assert all(len(of) == 1 for of in nodes.values()), nodes
    assert Counter(node for of in nodes.values() for node in of) == GPUS
    assert outcomes["no-room"] == len(goals) - len(ledger) > 0
    rig.assert_sound(bare)


def outcome(ticket: Any) -> str:
    """Return a demand's outcome, or the code of its refusal."""
    try:
        return rig.receipt(ticket).outcome
    except Refused as refused:
        return refused.faults[0].code
