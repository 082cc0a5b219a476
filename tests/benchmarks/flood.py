"""Measure how long a demand waits while another requester sends the worst that we know.

A requester sends five demands of one kind, and another requester sends an ordinary demand at once
afterwards. The benchmark prints the seconds until the ordinary demand has its receipt and the
processor seconds of all, and writes ``build/flood.json``.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from demandops.base.errors import DemandOpsError
from demandops.serve.generator import Generator
from rich.console import Console

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


def _link(name: str, target: str = "edge", topics: int = 1) -> Demand:
    listed = [{"source": f"/{name}/t{index}"} for index in range(topics)]
    ends = {"source": "vehicle00", "target": target}
    return {"id": name, "type": "mqtt", "topics": listed} | ends


def _demand(name: str, apps: list[Demand], links: list[Demand], *who: str) -> Demand:
    head = {"kind": "Demand", "demand": name, "requesters": ["attacker", *who]}
    return head | {"applications": apps, "connections": links}


KINDS: dict[str, Callable[[str], Demand]] = {
    "nothing": lambda name: goals.leave(2),
    "1,000 placements and 4,000 connections, refused everywhere": lambda name: _demand(
        name,
        [_app(f"{name}_{n}", connect="none") for n in range(1000)],
        [*(_link(f"{name}_{n}") for n in range(3999)), _link(f"{name}_x", "vehicle01")],
    ),
    "1,000 placements, denied on ten nodes": lambda name: _demand(
        name, [_app(f"{name}_{n}", connect="none") for n in range(1000)], []
    ),
    "25 placements, denied, and 4,000 connections": lambda name: _demand(
        name,
        [_app(f"{name}_{n}", connect="none") for n in range(25)],
        [_link(f"{name}_{n}") for n in range(4000)],
    ),
    "19,000 topics": lambda name: _demand(name, [_app(name, 19_000, node="edge")], []),
    "4,900 topics": lambda name: _demand(name, [_app(name, 4_900, node="edge")], []),
    "9,900 topics of a connection": lambda name: _demand(name, [], [_link(name, topics=9_900)]),
    "4,900 connections": lambda name: _demand(
        name, [], [_link(f"{name}_{n}") for n in range(4_900)]
    ),
    "9,000 deliveries": lambda name: _demand(
        name,
        [
            _app(
                name,
                deliver=[
                    {"output": "object-fusion.objects", "node": "cloud", "topic": f"/x{n}"}
                    for n in range(9_000)
                ],
            )
        ],
        [],
    ),
    "99 requesters of 49 connections": lambda name: _demand(
        name, [], [_link(f"{name}_{n}") for n in range(49)], *(f"r{n}" for n in range(98))
    ),
}


def _waited(folder: Path, attack: Callable[[str], Demand]) -> dict[str, float]:
    path = folder / "state.git"
    repo.init(path)
    nodes = [{"id": f"e{n:03}", "type": "edge", "cluster": "c-its"} for n in range(EDGES)]
    person = repo.Person(path, folder / "person")
    person.change(
        {
            "inventory/nodes/edges.yaml": yaml.safe_dump(
                {"apiVersion": "demandops/v1", "kind": "Nodes", "nodes": nodes}
            ),
            "overrides/no.yaml": override({"nodes": ["e00*"]}, deny=True),
        },
        "More edges",
    )
    generator = Generator(str(path), data=folder / "data")
    try:
        generator.submit(goals.numbered(1)).future.result()
        worked = time.process_time()
        attacks = [generator.submit(attack(f"d{number}")) for number in range(ATTACKS)]
        start = time.perf_counter()
        generator.submit(goals.numbered(3)).future.result()
        waited = time.perf_counter() - start
        for ticket in attacks:
            try:
                ticket.future.result()
            except DemandOpsError:
                continue
        return {"waited_s": waited, "processor_s": time.process_time() - worked}
    finally:
        generator.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--output", type=Path, default=Path("build/flood.json"))
    args = parser.parse_args()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, attack in KINDS.items():
        with TemporaryDirectory(prefix="bench-", dir=args.output.parent) as folder:
            rows.append({"attack": name, **_waited(Path(folder), attack)})
    out = Console(highlight=False)
    out.print(fleet.table(f"One demand behind {ATTACKS} of another requester", rows))
    args.output.write_text(json.dumps(rows, indent=2) + "\n")
    out.print(f"written to {args.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
