"""Read the vehicles' tracks from the poses in a recorded bag, MCAP or sqlite3."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path

from demandops.detect import rule_file
from demandops_ros.detector.replay import RecordedBag

from .routes import LEAD_S, VEHICLES, Track
from .rules import RULES, Near


def bag_tracks(bag: Path, near: Near) -> tuple[Track, ...]:
    """Return the track of each vehicle in a bag, or end with the reason why it cannot be played."""
    rules = rule_file.read(RULES.read_text(), RULES.name)
    points: dict[str, list[tuple[float, float, float]]] = {}
    first: float | None = None
    with closing(RecordedBag(bag, rules)) as reader:
        for one in reader.observations():
            if one.position is not None:
                first = one.at if first is None else first
                x, y = one.position[0] - near.point[0], one.position[1] - near.point[1]
                points.setdefault(one.entity, []).append((one.at - first + LEAD_S, x, y))
    if others := points.keys() - set(VEHICLES):
        raise SystemExit(
            f"{bag}: has poses of {', '.join(sorted(others))}; the experiment has nodes for "
            f"{', '.join(VEHICLES)} only, so rename the topics"
        )
    found = tuple(Track(vehicle, tuple(points[vehicle])) for vehicle in sorted(points))
    for track in found:
        if math.hypot(*track.position(0.0)) <= near.stop:
            raise SystemExit(
                f"{bag}: {track.vehicle} begins within {near.stop:g} m of the station; start the "
                "recording earlier"
            )
    return found
