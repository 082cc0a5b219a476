"""Read the vehicles' tracks from the poses in a recorded bag, MCAP or sqlite3."""

from __future__ import annotations

import math
from pathlib import Path

from demandops.detect import rule_file
from demandops_ros.detector.replay import RecordedBag

from .routes import VEHICLES, Track, tracks
from .rules import RULES, Near


def bag_tracks(bag: Path, near: Near) -> tuple[Track, ...]:
    """Return the track of each vehicle in a bag, or end with the reason why it cannot be played."""
    reader = RecordedBag(bag, rule_file.read(RULES.read_text(), RULES.name))
    try:
        seen = [(one.at, one.entity, one.position) for one in reader.observations()]
    finally:
        reader.close()
    poses = [(at, vehicle, *place) for at, vehicle, place in seen if place is not None]
    found = tracks(poses, near.point)
    others = {track.vehicle for track in found} - set(VEHICLES)
    if others:
        raise SystemExit(
            f"{bag}: has poses of {', '.join(sorted(others))}; the experiment has nodes for "
            f"{', '.join(VEHICLES)} only, so rename the topics"
        )
    for track in found:
        if math.hypot(*track.position(0.0)) <= near.stop:
            raise SystemExit(
                f"{bag}: {track.vehicle} begins within {near.stop:g} m of the station; start the "
                "recording earlier"
            )
    return found
