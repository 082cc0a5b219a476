"""Tries rules on a recorded bag, and shows which demands they would make, and when."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from math import dist
from typing import Any

from demandops.cli import json_output
from demandops.cli.output import errors
from demandops.cli.table import Column, Table
from demandops.detection.detector import Detector
from demandops.detection.events.detection_state import Event, Key, Observation
from demandops.detection.rules.rule_demand import Goal
from demandops.detection.rules.rule_file import RuleFile

from demandops_ros.detector.recorded_bag import REST_OF_BAG, RecordedBag

# How many messages the detector gets at a time; the number does not change the events.
_TOGETHER = 1_000
# The least distance in metres between two points of an entity's track in the plot.
_TRACK_M = 0.5


@dataclass
class Replay:
    bag: str
    file: RuleFile
    span: tuple[float, float]  # from the first message to the last
    topics: list[str]
    messages: int = 0  # that are readable, each once for every source that reads it
    events: list[tuple[Event, Goal | None]] = field(default_factory=list)
    lasting: list[Key] = field(default_factory=list)  # events that have not stopped at the end
    left_out: Mapping[tuple[str, str], int] = field(default_factory=dict)
    # Each entity's path, for a plot.
    tracks: dict[tuple[str, str], list[tuple[float, float]]] = field(default_factory=dict)


def replayed(name: str, bag: RecordedBag, file: RuleFile) -> Replay:
    """Return the events that rules make from a bag, at the times when messages were recorded."""
    start, end = bag.span
    detector = Detector(file, start)
    replay = Replay(name, file, (start, end), sorted(bag.topics))
    waiting: list[Observation] = []

    def step(now: float) -> None:
        for event, want in detector.step(waiting, now):
            replay.events.append((event, want.goal))
        waiting.clear()

    for observation in bag.observations():
        waiting.append(observation)
        replay.messages += 1
        if observation.position is not None:
            track = replay.tracks.setdefault(observation.who, [])
            if not track or dist(track[-1], observation.position) >= _TRACK_M:
                track.append(observation.position)
        if len(waiting) >= _TOGETHER:
            step(observation.at)
    step(end)
    replay.lasting, replay.left_out = sorted(detector.lasting), dict(bag.left_out)
    return replay


def show(replay: Replay, output: str) -> None:
    columns = [
        Column("Second"),
        Column("Change"),
        Column("Rule"),
        Column("Entities"),
        Column("Why", rank=2, wraps=True),
        Column("Demand", rank=1),
    ]
    rows = [
        (
            f"{event.at - replay.span[0]:.1f}",
            "start" if event.starts else "stop",
            event.rule,
            ", ".join(event.subjects),
            event.why,
            "" if goal is None else goal.id,
        )
        for event, goal in replay.events
    ]
    summary = (
        f"{replay.messages} messages on {len(replay.topics)} topics in "
        f"{replay.span[1] - replay.span[0]:.1f} s; events that have not stopped: "
        f"{len(replay.lasting)}"
    )
    json_output.show(output, as_data(replay), [Table(columns, rows), summary])
    for (topic, why), count in replay.left_out.items():
        lost = " is" if topic == REST_OF_BAG else f": {count} messages are"
        errors.print(f"warning: {topic}{lost} left out: {why}")


def as_data(replay: Replay) -> dict[str, Any]:
    """Return a replay as plain data for ``--output json``, on whose form programs rely."""
    return {
        "bag": replay.bag,
        "from": _time(replay.span[0]),
        "to": _time(replay.span[1]),
        "topics": replay.topics,
        "messages": replay.messages,
        "left_out": [
            {"topic": topic, "reason": why, "messages": count}
            for (topic, why), count in replay.left_out.items()
        ],
        "events": [
            {
                "time": _time(event.at),
                "second": round(event.at - replay.span[0], 3),
                "rule": event.rule,
                "entities": list(event.subjects),
                "change": "start" if event.starts else "stop",
                "reason": event.why,
                "action": None if goal is None else goal.action_name,
                "goal": None if goal is None else goal.document,
            }
            for event, goal in replay.events
        ],
        "lasting": [
            {"rule": rule, "entities": list(subjects)} for rule, subjects in replay.lasting
        ],
    }


def _time(seconds: float) -> str:
    moment = datetime.fromtimestamp(seconds, timezone.utc)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
