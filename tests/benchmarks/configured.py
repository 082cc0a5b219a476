"""Measure a join with every kind of decision configured, and with none of them.

Two state repos have the same fleet. In the second one, services request capacity of their nodes,
scale by sources, keep replicas for a while, may run in several versions side by side, and are
shared with another application of the cluster. Each edge is also in a further access domain with
rules, quotas and leases.

Two generators in one process take turns, so that other work on the machine affects both alike. A
vehicle joins by a goal of the reference's action, and by a demand in DemandOps' own format. In the
second repo, this demand leaves the node to the generator. The wall-clock time ends with the
receipt; CPU time counts until the process is idle again. The ratios are those of the medians.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml
from demandops.serve.generator import Generator

from tests.benchmarks import fleet
from tests.kit import goals

RELEASES = 10_000
ROUNDS = 60
WARM_UP = 8
_IDLE_S = 0.05

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"


def configure(files: dict[str, str]) -> None:
    """Change a configuration's ``files`` so that they configure every kind of decision."""
    appdef = yaml.safe_load(files[APPDEF])
    appdef["versions"] = "separate"
    for service, scaling in (
        ("object-detection", {"max": 1}),
        ("object-fusion", {"max": 4, "per": {"sources": 8}, "downAfter": "10m"}),
    ):
        own = appdef["services"][service]
        own["scaling"] = scaling | {"dividesWork": True}
        own["requests"] = {"cpu": "100m", "memory": "64Mi"}
    nodes = yaml.safe_load(files["inventory/nodes.yaml"])
    for number, node in enumerate(nodes["nodes"]):
        node["position"] = {"x": number % 100, "y": number // 100}
        if node["type"] == "edge":
            node["capabilities"] = ["gpu"]
            node["capacity"] = {"cpu": "64", "memory": "64Gi"}
            node["accessDomains"] = [{"name": "city"}]
    more = yaml.safe_load(Path(__file__).with_name("configured.yaml").read_text())
    files |= {path: yaml.safe_dump(content) for path, content in more.items()}
    files |= {
        APPDEF: yaml.safe_dump(appdef),
        "inventory/nodes.yaml": yaml.dump(nodes, Dumper=yaml.CSafeDumper),
        "appdefs/map-server/values/map-server.yaml.j2": "replicas: {{ replicas }}\n",
    }


def _times(generator: Generator, goal: dict[str, Any]) -> tuple[float, float]:
    """Book a goal; return its wall-clock time and the CPU time of all threads, in milliseconds."""
    cpu = time.process_time()
    clock, _ = fleet.costs(generator, goal)
    return clock * 1e3, (_when_idle() - cpu) * 1e3


def _when_idle() -> float:
    """Wait until the process has nothing left to do; return its CPU time so far."""
    before = time.process_time()
    while True:
        time.sleep(_IDLE_S)
        now = time.process_time()
        if now - before < _IDLE_S / 20:
            return now
        before = now


def reference(edge: int, *, placed: bool) -> list[dict[str, Any]]:
    """Return a join and a shutdown for the reference's action, which always name the node."""
    join = fleet.goal(fleet.edge_id(edge), fleet.spare_id(edge))
    return [join, join | {"shutdown": True}]


def demand(edge: int, *, placed: bool) -> list[dict[str, Any]]:
    """Return a put and a release for the action ``Demand``; if ``placed``, without a node."""
    who, node = fleet.spare_id(edge), fleet.edge_id(edge)
    made = goals.put(f"of-{who}", who, topic=(f"/{who}/ego", who), node="" if placed else node)
    made["applications"][0]["connect"] = "mqtt"
    if placed:
        labels = [f"node_id={node}"]
        place = {"role": "edge", "labels": labels, "capabilities": ["gpu"]}
        made["applications"][0]["place"] = place
    release = {k: v for k, v in made.items() if k != "applications"} | {"operation": "release"}
    return [made, release]


def measure(
    name: str, goals_at: Callable[..., Any], both: list[Generator], laid: fleet.Fleet
) -> dict[str, Any]:
    """Return the median times of a join with nothing and with everything configured."""
    taken: list[list[tuple[float, float]]] = [[], []]
    for number in range(ROUNDS + WARM_UP):
        for place in (0, 1) if number % 2 else (1, 0):
            join, leave = goals_at(number % laid.edges, placed=bool(place))
            taken[place].append(_times(both[place], join))
            _times(both[place], leave)
    row: dict[str, Any] = {"join": name, "releases": laid.releases, "nodes": laid.nodes}
    for index, how in enumerate(("clock", "cpu")):
        medians = [statistics.median(one[index] for one in of[WARM_UP:]) for of in taken]
        row |= {f"{how}_ms": medians[0], f"{how}_configured_ms": medians[1]}
        row[f"{how}_ratio"] = medians[1] / medians[0]
    return row


def main() -> None:
    with fleet.workspace() as made:
        folder = Path(made)
        plain = fleet.lay_down(folder / "plain.git", RELEASES)
        full = fleet.lay_down(folder / "configured.git", RELEASES, configure=configure)
        with (
            closing(Generator(str(plain.path), data=folder / "plain")) as one,
            closing(Generator(str(full.path), data=folder / "configured")) as other,
        ):
            kinds = {"reference": reference, "demand": demand}
            rows = [measure(name, kind, [one, other], plain) for name, kind in kinds.items()]
    title = "A join, with nothing and with everything configured (medians)"
    fleet.report("configured", **{title: rows})


if __name__ == "__main__":
    main()
