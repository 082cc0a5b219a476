"""Measure how long a demand waits while another requester sends the worst that we know.

A requester sends five demands of one kind, and another requester sends an ordinary demand at once
afterwards. The figures are the seconds until the ordinary demand has its receipt, and the processor
seconds of all.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import yaml
from demandops.base.errors import DemandOpsError
from demandops.serve.generator import Generator

from tests.benchmarks import fleet
from tests.kit import goals, repo
from tests.kit.config import override

EDGES = 50
ATTACKS = 5

Demand = dict[str, Any]


def _app(name: str, topics: int = 1, **more: Any) -> Demand:
    listed = [{"topic": f"/{name}/t{index}", "source": "vehicle00"} for index in range(topics)]
    made = {"id": name, "type": "object-detection-fusion", "inputs": {"ego_data": listed}}
    return made | ({} if "node" in more else {"place": {"role": "edge"}}) | more


def _placed(name: str, count: int) -> list[Demand]:
    return [_app(f"{name}_{n}", connect="none") for n in range(count)]


def _link(name: str, target: str = "edge", topics: int = 1) -> Demand:
    listed = [{"source": f"/{name}/t{index}"} for index in range(topics)]
    ends = {"source": "vehicle00", "target": target}
    return {"id": name, "type": "mqtt", "topics": listed} | ends


def _links(name: str, count: int) -> list[Demand]:
    return [_link(f"{name}_{n}") for n in range(count)]


def _demand(
    name: str, apps: Iterable[Demand] = (), links: Iterable[Demand] = (), who: Iterable[str] = ()
) -> Demand:
    head = {"kind": "Demand", "demand": name, "requesters": ["attacker", *who]}
    return head | {"applications": [*apps], "connections": [*links]}


def _deliveries(name: str) -> list[Demand]:
    to = {"output": "object-fusion.objects", "node": "cloud"}
    return [_app(name, deliver=[to | {"topic": f"/x{n}"} for n in range(9_000)])]


KINDS: dict[str, Callable[[str], Demand]] = {
    "nothing": lambda name: goals.leave(2),
    "1,000 placements and 4,000 connections, refused everywhere": lambda name: _demand(
        name, _placed(name, 1000), [*_links(name, 3999), _link(f"{name}_x", "vehicle01")]
    ),
    "1,000 placements, denied on ten nodes": lambda name: _demand(name, _placed(name, 1000)),
    "25 placements, denied, and 4,000 connections": lambda name: _demand(
        name, _placed(name, 25), _links(name, 4000)
    ),
    "19,000 topics": lambda name: _demand(name, [_app(name, 19_000, node="edge")]),
    "4,900 topics": lambda name: _demand(name, [_app(name, 4_900, node="edge")]),
    "9,900 topics of a connection": lambda name: _demand(name, [], [_link(name, topics=9_900)]),
    "4,900 connections": lambda name: _demand(name, [], _links(name, 4_900)),
    "9,000 deliveries": lambda name: _demand(name, _deliveries(name)),
    "99 requesters of 49 connections": lambda name: _demand(
        name, [], _links(name, 49), (f"r{n}" for n in range(98))
    ),
}


def _waited(folder: Path, attack: Callable[[str], Demand]) -> dict[str, float]:
    path = repo.init(folder / "state.git")
    nodes = [{"id": f"e{n:03}", "type": "edge", "cluster": "c-its"} for n in range(EDGES)]
    edges = {"apiVersion": "demandops/v1", "kind": "Nodes", "nodes": nodes}
    files = {
        "inventory/nodes/edges.yaml": yaml.safe_dump(edges),
        "overrides/no.yaml": override({"nodes": ["e00*"]}, deny=True),
    }
    repo.Person(path, folder / "person").change(files, "More edges")
    with closing(Generator(str(path), data=folder / "data")) as generator:
        generator.submit(goals.numbered(1)).future.result()
        worked = time.process_time()
        attacks = [generator.submit(attack(f"d{number}")) for number in range(ATTACKS)]
        waited, _ = fleet.costs(generator, goals.numbered(3))
        for ticket in attacks:
            with suppress(DemandOpsError):
                ticket.future.result()
        return {"waited_s": waited, "processor_s": time.process_time() - worked}


def main() -> None:
    rows = []
    for name, attack in KINDS.items():
        with fleet.workspace() as folder:
            rows.append({"attack": name, **_waited(Path(folder), attack)})
    fleet.report("flood", **{f"One demand behind {ATTACKS} of another requester": rows})


if __name__ == "__main__":
    main()
