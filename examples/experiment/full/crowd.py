"""The inventory, rules and checks of the larger experiment, as pure functions.

The larger experiment has many vehicles, and three intersections with an edge and a station each.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import yaml

from tests.e2e.common.expected import CLUSTER

from . import fleet
from .checks import Check, check_nodes, differ
from .outcome import Formed, Outcome
from .routes import MIDDLES
from .rules import RULES, Event, Near, Pose, events_of

FLEET = "vehicles"
"""The cluster of the vehicles; all other nodes are in the skeleton's cluster."""
EDGES = tuple(f"edge{number:02}" for number in range(len(MIDDLES)))
STATIONS = tuple(f"station{number:02}" for number in range(len(MIDDLES)))
NODES = (*EDGES, *STATIONS, "cloud")


def crossings(near: Near) -> tuple[Near, ...]:
    """Return a nearness condition for each intersection; the first one is the paper's condition."""
    (x, y) = near.point
    return tuple(replace(near, point=(x + dx, y + dy)) for dx, dy in MIDDLES)


def files(vehicles: Collection[str], clusters: str) -> dict[str, str]:
    """Return the inventory's texts by path; `clusters` is the skeleton's `clusters.yaml`."""
    places: dict[str, Any] = yaml.safe_load(clusters)
    places["clusters"].append({"name": FLEET})
    kinds = dict.fromkeys(vehicles, "vehicle") | {node: node.rstrip("0123456789") for node in NODES}
    nodes = [
        {"id": node, "type": kind, "cluster": FLEET if kind == "vehicle" else CLUSTER}
        for node, kind in kinds.items()
    ]
    brokers = [{"node": edge, "host": edge, "port": 1883} for edge in EDGES]
    head = {"apiVersion": "demandops/v1"}
    return {
        "inventory/clusters.yaml": yaml.safe_dump(places),
        "inventory/nodes.yaml": yaml.safe_dump({**head, "kind": "Nodes", "nodes": nodes}),
        "inventory/brokers.yaml": yaml.safe_dump({**head, "kind": "Brokers", "brokers": brokers}),
    }


def rules(near: Near) -> str:
    """Return the example's last rule, for vehicles without a lidar, for each intersection."""
    found: dict[str, Any] = yaml.safe_load(RULES.read_text())
    text = yaml.safe_dump(found["rules"][-1])
    found["rules"] = []
    for number, crossing in enumerate(crossings(near)):
        rule = yaml.safe_load(text.replace("station00", STATIONS[number]))
        rule = yaml.safe_load(
            yaml.safe_dump(rule)
            .replace("/edge", f"/{EDGES[number]}")
            .replace(": edge\n", f": {EDGES[number]}\n")
            .replace("edge/", f"{EDGES[number]}/")
        )
        x, y = crossing.point
        rule |= {"name": f"at-{STATIONS[number]}", "entities": ["vehicle*"]}
        rule["near"]["point"] = {"x": x, "y": y}
        found["rules"].append(rule)
    return yaml.safe_dump(found)


def events(poses: Iterable[Pose], passing: Mapping[str, Near], until: float) -> list[Event]:
    """Return the events before `until` in order; `passing` maps vehicles to their intersections."""
    own: defaultdict[Near, list[Pose]] = defaultdict(list)
    for pose in poses:
        own[passing[pose.vehicle]].append(pose)
    found = [event for near, some in own.items() for event in events_of(some, near, until)]
    return sorted(found, key=lambda event: event.at)


def requesters(inside: Mapping[str, int]) -> dict[str, list[str]]:
    """Return the requesters while each vehicle is near the intersection of this number."""
    rows: dict[str, list[str]] = {}
    for number, (edge, station) in enumerate(zip(EDGES, STATIONS, strict=True)):
        rows |= fleet.requesters([one for one, at in inside.items() if at == number], edge, station)
    return dict(sorted(rows.items()))


def checks(outcome: Outcome, passing: Mapping[str, int]) -> list[Check]:
    """Return the checks of a run in which no container runs and no data flows."""
    return [
        Check("the detector formed the demands that a plain script over the poses gives",
              differ(_by_vehicle(outcome.events), _by_vehicle(outcome.formed))),
        Check("at the commits whose bookkeeping was read, the requesters of every service and "
              "connection are right", "; ".join(_requesters(outcome.formed, passing))),
        Check("every pod ran on the node that it was for", "; ".join(check_nodes(outcome))),
        Check("at the end both clusters are as before",
              differ(sorted(outcome.before), sorted(outcome.left))),
    ]  # fmt: skip


def _by_vehicle(found: Iterable[Event] | Iterable[Formed]) -> dict[str, list[bool]]:
    """Return each vehicle's joins (true) and leaves (false) in order."""
    by_vehicle: defaultdict[str, list[bool]] = defaultdict(list)
    for one in found:
        by_vehicle[one.vehicle].append(one.joins)
    return dict(sorted(by_vehicle.items()))


def _requesters(formed: Iterable[Formed], passing: Mapping[str, int]) -> Iterator[str]:
    inside: dict[str, int] = {}
    for one in formed:
        if one.joins:
            inside[one.vehicle] = passing[one.vehicle]
        else:
            inside.pop(one.vehicle, None)
        if one.bookkeeping is not None and (fault := differ(requesters(inside), one.bookkeeping)):
            yield f"{one}: {fault}"
