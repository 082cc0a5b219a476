"""The objects that must exist after each step of the paper's experiment, one per line.

The lines follow from the paper's table, not from the program, so the names of objects are written
out here. An object exists if its row of `examples/experiment/paper.py` has requesters.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from examples.experiment import paper
from tests.kit.goals import experiment as demand  # noqa: F401 - tests take it from here

CLUSTER = "c-its"
"""The cluster of the skeleton."""
NAMESPACE = "perception"
"""The skeleton's access domain, and the domain's namespace."""

STEPS = range(1, len(paper.STEPS) + 1)
VEHICLES = ("vehicle00", "vehicle01", "vehicle02", "vehicle03")
NODES = (*VEHICLES, "station00", "edge", "cloud")

FUSION = "of-edge-object-detection-fusion-cf7e0180a8bb"
DETECTION = {"station00": "od-edge-station00", "vehicle00": "od-edge-vehicle00"}
_ENDS = {
    "station00": ("8f7ef611a10a", "5001de78ddb2"),
    "vehicle00": ("d3ca91c2df6c", "3c0f22bda69b"),
    "vehicle01": ("092a70a6cc97", "f918b3fb6980"),
    "vehicle02": ("8e8a3b8b98be", "18e6ba1f4096"),
    "vehicle03": ("f675fa2fc9b2", "b53be9798cf6"),
}

# One is from `_domain.yaml`; Kubernetes adds the other to every namespace.
WITHOUT_DEMANDS = frozenset({"ConfigMap demandops-domain", "ConfigMap kube-root-ca.crt"})


def source_end(node: str) -> str:
    return f"mqtt-{node}-edge-source-{_ENDS[node][0]}"


def target_end(node: str) -> str:
    """Return the name of the client that runs on the edge for a node's connection to the edge."""
    return f"mqtt-{node}-edge-target-{_ENDS[node][1]}"


def after(step: int, nodes: Collection[str] = NODES) -> frozenset[str]:
    """Return a line for each object that a cluster with these nodes must have after a step."""
    rows = paper.expected(step) if step else {}
    lines = [line for row in rows for node, line in _of_row(row, rows) if node in nodes]
    return WITHOUT_DEMANDS | frozenset(lines)


def _of_row(row: str, rows: dict[str, list[str]]) -> Iterator[tuple[str, str]]:
    kind, subject = row.split(" ", 1)
    if kind == "connection":
        node = subject.removesuffix(" to edge")
        yield from _end(node, source_end(node))
        yield from _end("edge", target_end(node))
        return
    name = FUSION if kind == "object-fusion" else DETECTION[subject]
    yield from (("edge", line) for line in (f"release {name}", *_deployed("edge", name)))
    if kind == "object-fusion":
        yield from (("edge", f"ConfigMap {name}-{part}") for part in ("params", "watcher"))
        for node in rows[row]:
            if node in VEHICLES:
                yield "edge", f"fusion takes /vehicles/{node}/ego_data"
        for source in DETECTION:
            if f"object-detection {source}" in rows:
                yield "edge", f"fusion takes /{source}_local_objectlist"


def _end(node: str, name: str) -> Iterator[tuple[str, str]]:
    yield from ((node, line) for line in (f"ConfigMap {name}", *_deployed(node, name)))


def _deployed(node: str, name: str) -> tuple[str, str]:
    return f"Deployment {name}", f"pod of {name} on {node}, ready"


def unscheduled(lines: frozenset[str]) -> frozenset[str]:
    """Return the lines, changed to say that the edge's pods have no node and are not ready."""
    return frozenset(line.replace(" on edge, ready", " on no node, not ready") for line in lines)
