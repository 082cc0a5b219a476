"""Measure a join with every kind of decision configured, and with none of them.

Two state repos have the same fleet. In the second one, services request capacity of their nodes,
scale by sources, keep replicas for a while, may run in several versions side by side, and are
shared with another application of the cluster. Each edge is also in a further access domain with
rules, quotas and leases.

Two generators in one process take turns, so that other work on the machine affects both alike. A
vehicle joins by a goal of the reference's action, and by a demand in DemandOps' own format. In the
second repo, this demand leaves the node to the generator. The wall-clock time ends with the
receipt; CPU time counts until the process is idle again. The benchmark prints the ratios of the
medians and writes ``build/configured.json``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from demandops.serve.generator import Generator
from rich.console import Console

from tests.benchmarks import fleet
from tests.kit import goals

RELEASES = 10_000
ROUNDS = 60
WARM_UP = 8
_IDLE_S = 0.05

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
MAP_SERVER = """
apiVersion: demandops/v1
kind: ServiceDefinition
name: map-server
scope: cluster
nodes: {region0000: edge00000}
prefix: map
inputs: {points: {}}
chart: object-fusion
images: [object-fusion]
values: values/map-server.yaml.j2
"""
MAPPING = """
apiVersion: demandops/v1
kind: ApplicationDefinition
name: mapping
inputs: {point_cloud: {}}
uses: {map-server: {points: point_cloud}}
"""
VERSIONS = """
apiVersion: demandops/v1
kind: Versions
applications:
  object-detection-fusion:
    default: 1.0.0
    channels: {testing: 1.1.0}
    versions: {1.0.0: {}, 1.1.0: {images: {object-detection: {tag: next}}}}
"""
DOMAINS = """
apiVersion: demandops/v1
kind: AccessDomains
domains:
  - name: perception
    namespace: perception
    nodes: ["*"]
    rules:
      - {name: vehicles, requesters: ["v*", "newcomer*"], applications: ["*"], nodes: ["*"]}
      - {name: operators, requesters: ["op-*"], peers: [city]}
    quotas: {claimsPerRequester: 20, servicesPerNode: 500}
    leases: {default: 1h, longest: 2h, slack: 30s, deploymentRequests: true}
  - name: city
    namespace: city
    nodes: [nothing-else]
    ros: {domainId: 42}
    rules:
      - {name: control, requesters: ["traffic-*"], peers: [perception]}
"""


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
    files |= {
        APPDEF: yaml.safe_dump(appdef),
        "inventory/nodes.yaml": yaml.dump(nodes, Dumper=yaml.CSafeDumper),
        "policy/access-domains.yaml": DOMAINS,
        "registry/versions.yaml": VERSIONS,
        "appdefs/map-server/service.yaml": MAP_SERVER,
        "appdefs/map-server/values/map-server.yaml.j2": "replicas: {{ replicas }}\n",
        "appdefs/mapping/appdef.yaml": MAPPING,
    }


Times = tuple[float, float]


def _times(generator: Generator, goal: dict[str, Any]) -> Times:
    """Book a goal; return its wall-clock time and the CPU time of all threads, in milliseconds."""
    clock, cpu = time.perf_counter(), time.process_time()
    generator.submit(goal).future.result()
    clock = time.perf_counter() - clock
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
    """Return a put and a release for the action ``Demand``.

    If ``placed``, the put leaves the choice of the node to the generator.
    """
    who, node = fleet.spare_id(edge), fleet.edge_id(edge)
    made = goals.put(f"of-{who}", who, topic=(f"/{who}/ego", who), node="" if placed else node)
    made["applications"][0]["connect"] = "mqtt"
    if placed:
        made["applications"][0]["place"] = {
            "role": "edge",
            "labels": [f"node_id={node}"],
            "capabilities": ["gpu"],
        }
    release = {k: v for k, v in made.items() if k != "applications"} | {"operation": "release"}
    return [made, release]


GOALS: dict[str, Callable[..., list[dict[str, Any]]]] = {"reference": reference, "demand": demand}


def measure(folder: Path, releases: int, rounds: int) -> list[dict[str, Any]]:
    """Return a row for each kind of demand.

    A row has the median time of a join with nothing configured, the median time with everything
    configured, and the ratio of the latter to the former.
    """
    plain = fleet.lay_down(folder / "plain.git", releases)
    full = fleet.lay_down(folder / "configured.git", releases, configure=configure)
    with ExitStack() as stack:
        both = [
            stack.enter_context(closing(Generator(str(one.path), data=folder / name)))
            for name, one in (("plain", plain), ("configured", full))
        ]
        return [_row(name, made, both, plain, rounds) for name, made in GOALS.items()]


def _row(
    name: str,
    made: Callable[..., list[dict[str, Any]]],
    both: list[Generator],
    laid: fleet.Fleet,
    rounds: int,
) -> dict[str, Any]:
    taken: list[list[Times]] = [[], []]
    for number in range(rounds + WARM_UP):
        for place in (0, 1) if number % 2 else (1, 0):
            join, leave = made(number % laid.edges, placed=bool(place))
            taken[place].append(_times(both[place], join))
            _times(both[place], leave)
    row: dict[str, Any] = {"join": name, "releases": laid.releases, "nodes": laid.nodes}
    for index, how in enumerate(("clock", "cpu")):
        medians = [statistics.median(one[index] for one in of[WARM_UP:]) for of in taken]
        row |= {f"{how}_ms": medians[0], f"{how}_configured_ms": medians[1]}
        row[f"{how}_ratio"] = medians[1] / medians[0]
    return row


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--releases", type=int, default=RELEASES)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--output", type=Path, default=Path("build/configured.json"))
    args = parser.parse_args()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="bench-", dir=args.output.parent) as folder:
        rows = measure(Path(folder), args.releases, args.rounds)
    out = Console(highlight=False)
    out.print(fleet.table("A join, with nothing and with everything configured (medians)", rows))
    args.output.write_text(json.dumps(rows, indent=2) + "\n")
    out.print(f"written to {args.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
