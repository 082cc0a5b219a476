"""The paper's table: who requests which service and connection after each of eight steps.

The detection on the station's point cloud and the connection of this cloud have the same
requesters. The detection on vehicle00's point cloud and the connection of that cloud have the same
requesters, too.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

STEPS = (
    "vehicle00 joins",
    "vehicle01 joins",
    "vehicle03 joins",
    "vehicle02 joins",
    "vehicle00 leaves",
    "vehicle01 leaves",
    "vehicle02 leaves",
    "vehicle03 leaves",
)

S, V0, V1, V2, V3 = "station00", "vehicle00", "vehicle01", "vehicle02", "vehicle03"

# a row for each step: the requesters of the detection on the station's cloud, those of the
# detection on vehicle00's cloud, those of the fusion, and which of vehicle01 to vehicle03 have a
# connection
_TABLE: tuple[tuple[set[str], set[str], set[str], tuple[str, ...]], ...] = (
    ({S, V0}, {S, V0}, {S, V0}, ()),
    ({S, V0, V1}, {S, V0}, {S, V0, V1}, (V1,)),
    ({S, V0, V1, V3}, {S, V0}, {S, V0, V1, V3}, (V1, V3)),
    ({S, V0, V1, V2, V3}, {S, V0}, {S, V0, V1, V2, V3}, (V1, V2, V3)),
    ({S, V1, V2, V3}, set(), {S, V1, V2, V3}, (V1, V2, V3)),
    ({S, V2, V3}, set(), {S, V2, V3}, (V2, V3)),
    ({S, V3}, set(), {S, V3}, (V3,)),
    (set(), set(), set(), ()),
)


def expected(step: int) -> dict[str, list[str]]:
    """Return the sorted requesters of each subject after ``step`` (1 to 8)."""
    station, vehicle, fusion, connected = _TABLE[step - 1]
    rows = {
        f"object-detection {S}": station,
        f"object-detection {V0}": vehicle,
        "object-fusion edge/object_detection_fusion": fusion,
        f"connection {S} to edge": station,
        f"connection {V0} to edge": vehicle,
        **{f"connection {node} to edge": {S, node} for node in connected},
    }
    return {subject: sorted(who) for subject, who in sorted(rows.items()) if who}


def requesters(
    inside: Collection[str], edge: str = "edge", station: str = S
) -> dict[str, list[str]]:
    """Extend the table to any set of vehicles that are near, and to another intersection."""
    if not inside:
        return {}
    everybody = sorted({station, *inside})
    rows = {
        f"connection {station} to {edge}": everybody,
        f"object-detection {station}": everybody,
        f"object-fusion {edge}/object_detection_fusion": everybody,
    }
    rows |= {f"connection {vehicle} to {edge}": sorted({station, vehicle}) for vehicle in inside}
    if V0 in inside:
        rows[f"object-detection {V0}"] = sorted({station, V0})
    return dict(sorted(rows.items()))


def observed(books: dict[str, Any]) -> dict[str, list[str]]:
    """Return the requesters of each subject in a bookkeeping.

    ``books`` is the output of ``demandops bookkeeping --output json``.
    """
    rows = {}
    for entry in books["services"].values():
        target = entry["source"] or ", ".join(entry["applications"])
        rows[f"{entry['service']} {target}"] = entry["requesters"]
    for entry in books["connections"].values():
        rows[f"connection {entry['source']} to {entry['target']}"] = entry["requesters"]
    return dict(sorted(rows.items()))
