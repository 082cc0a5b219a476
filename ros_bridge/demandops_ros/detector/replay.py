"""``demandops detect --replay``: tries rules on a recorded bag."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from html import escape
from math import ceil, dist, inf
from pathlib import Path
from typing import Any

from demandops.base.errors import InvalidInput
from demandops.base.quoting import one_line
from demandops.cli import formats
from demandops.cli.formats import Table
from demandops.cli.output import errors
from demandops.detect.condition import Count, Near, entity_in
from demandops.detect.detector import Detector
from demandops.detect.event_engine import Event, Key, Observation
from demandops.detect.message_reader import (
    TF_TOPICS,
    TF_TYPE,
    FrameTree,
    MessageReader,
    Unreadable,
)
from demandops.detect.rule_file import Goal, RuleFile
from demandops.views.rows import Column
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

# ---- a recorded bag, MCAP or sqlite3, read without ROS ----

# Stands in `left_out` for the damaged end of a bag, whose topics are unknown. Its count is 1, as
# the lost messages cannot be counted.
REST_OF_BAG = "the rest of the bag"


class _TopicsThatAreRead(Reader):
    # A definition of another topic may be missing, or none that the library can parse.

    def __init__(self, path: Path, is_read: Callable[[Connection], bool]) -> None:
        super().__init__(path)
        self._is_read = is_read

    @property
    def connections(self) -> list[Connection]:
        return [*filter(self._is_read, self.storage.connections)]


def _unsigned(kind: Any) -> Any:  # noqa: ANN401 - of nested tuples
    if isinstance(kind, tuple):
        return tuple(map(_unsigned, kind))
    return "uint8" if kind == "byte" else kind


def _installed(type_names: Iterable[str]) -> Typestore:
    # for a bag without definitions, as SQLite files were before ROS 2 Iron
    types, unread = get_typestore(Stores.LATEST), {*type_names}
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    while unread := unread - types.fielddefs.keys():
        package, _, name = (type_name := unread.pop()).split("/")
        folders = [Path(prefix, "share", package, "msg") for prefix in prefixes if prefix]
        for path in [path for folder in folders for path in folder.glob(f"**/{name}.msg")][:1]:
            definitions = get_types_from_msg(path.read_text(), type_name)
            types.register(definitions)
            unread |= {*re.findall(r"\w+/msg/\w+", repr(definitions))}
    return types


class RecordedBag:
    def __init__(self, path: Path, file: RuleFile) -> None:
        """Open a bag, a folder or an MCAP file, with at least one topic that the rules read."""
        self._frames = FrameTree(file.map.frame) if file.map and file.map.frame else None
        wanted = [(source.topic, source.type) for source in file.sources.values()]
        wanted += [(topic, TF_TYPE) for topic in TF_TOPICS if self._frames]

        def is_read(connection: Connection) -> bool:
            topic, type_name = connection.topic, connection.msgtype
            return any(
                type_name == each and entity_in(at, topic) is not None for at, each in wanted
            )

        try:
            installed = _installed(type_name for _, type_name in wanted)
            self._reader = AnyReader([path], default_typestore=installed)
            if self._reader.is2:
                self._reader.readers = [_TopicsThatAreRead(path, is_read)]
            self._reader.open()
            if not self._reader.message_count:
                raise ValueError("it has no messages")
            # a `byte` is 0 to 255, as live; the library takes it as signed
            definitions = self._reader.typestore.fielddefs
            for name, (constants, fields) in definitions.items():
                definitions[name] = constants, [(each, _unsigned(kind)) for each, kind in fields]
        except Exception as error:  # a damaged bag makes the library raise errors of any kind
            message = f"is not a bag that can be read: {one_line(str(error))}"
            raise InvalidInput.at("", message, file=str(path)) from None
        self._readers = {name: MessageReader(file, name, self._frames) for name in file.sources}
        self._sources: dict[int, list[tuple[str, str]]] = {}
        self.topics: set[str] = set()
        # Topics that match a source by name, but not by their message type.
        self.unread: dict[str, str] = {}
        # How many messages could not be read, by topic and reason. One that two sources read counts
        # twice.
        self.left_out: dict[tuple[str, str], int] = {}
        (reader,) = self._reader.readers
        recorded = reader.storage.connections if isinstance(reader, Reader) else reader.connections
        for connection in recorded:
            for name, source in file.sources.items():
                if (entity := entity_in(source.topic, connection.topic)) is None:
                    continue
                if connection.msgtype == source.type:
                    self._sources.setdefault(connection.id, []).append((name, entity))
                    self.topics.add(connection.topic)
                else:
                    self.unread[connection.topic] = connection.msgtype
        if not self.topics:
            topics = sorted({f"{item.topic} ({item.msgtype})" for item in recorded})
            named = ", ".join(f"{topic} ({type_name})" for topic, type_name in wanted)
            has = ", ".join(topics) or "no topic"
            self.close()
            message = f"has no topic that the rules read: {named}; it has {has}"
            raise InvalidInput.at("", message, file=str(path))

    def close(self) -> None:
        self._reader.close()

    @property
    def span(self) -> tuple[float, float]:
        # of the first and the last message of all topics, in seconds since 1970; the library's end
        # is a nanosecond after the last message
        return self._reader.start_time / 1e9, (self._reader.end_time - 1) / 1e9

    def observations(self) -> Iterator[Observation]:
        messages = self._reader.messages(self._reader.connections)
        while True:
            try:
                connection, nanoseconds, data = next(messages)
            except StopIteration:
                return
            except Exception as error:  # the rest of a damaged bag
                self._leave_out(REST_OF_BAG, f"cannot be read: {error!r}")
                return
            sources = self._sources.get(connection.id, [])
            try:
                message = self._reader.deserialize(data, connection.msgtype)
            except Exception as error:  # rosbags raises errors of many kinds
                for _ in sources:
                    self._leave_out(connection.topic, f"cannot be decoded: {error!r}")
                continue
            if self._frames and connection.topic in TF_TOPICS:
                self._frames.hear(message, TF_TOPICS[connection.topic], nanoseconds / 1e9)
            for source, entity in sources:
                try:
                    reader = self._readers[source]
                    if heard := reader.observation(message, entity, nanoseconds / 1e9):
                        yield heard
                except Unreadable as error:
                    self._leave_out(connection.topic, str(error))

    def _leave_out(self, topic: str, why: str) -> None:
        key = topic, one_line(why)
        self.left_out[key] = self.left_out.get(key, 0) + 1


# ---- the picture of a replay ----
#
# The upper part is a map with tracks and areas. Below, each rule with its entities (at most 200)
# has a row with a bar from each start to its stop.

_WIDTH, _MAP, _ROW, _LEFT, _RIGHT, _EDGE = 1000, 600, 22, 300, 30, 30
_COLORS = ("#0b6e99", "#c2410c", "#15803d", "#7e22ce", "#b91c1c", "#4d7c0f", "#be185d", "#1d4ed8")


def svg(replay: Replay) -> str:
    spans: dict[Key, list[tuple[float, float]]] = {}  # by rule and entities; inf: not stopped
    for event, _ in replay.events:
        if event.starts:
            spans.setdefault(event.key, []).append((event.at, inf))
        else:
            spans[event.key][-1] = spans[event.key][-1][0], event.at
    rows = [*spans.items()][:200]
    colors: dict[str, str] = {}

    def color_of(entity: str) -> str:
        return colors.setdefault(entity, _COLORS[len(colors) % len(_COLORS)])

    parts = [*_map(replay, color_of)]
    start, end = replay.span
    factor = (_WIDTH - _LEFT - _RIGHT) / ((end - start) or 1)
    bottom = _MAP + _ROW * (len(rows) + 1)
    step = _round((end - start) or 1) / 2
    for tick in range(ceil((end - start) / step) + 1 if end > start else 1):
        x = _LEFT + tick * step * factor
        if x <= _WIDTH - _RIGHT:
            parts.append(f'<path d="M{x:.1f} {_MAP}V{bottom}" stroke="#ddd"/>\n')
            parts.append(_text(x, bottom + 14, f"{tick * step:g} s", "black"))
    for number, ((rule, subjects), bars) in enumerate(rows, start=1):
        y = _MAP + _ROW * number
        color = color_of(subjects[0]) if subjects else "#444"
        parts.append(_text(_EDGE, y, f"{rule} {' '.join(subjects)}", "black"))
        for since, until in bars:
            x, width = _LEFT + (since - start) * factor, (min(until, end) - since) * factor
            parts.append(
                f'<rect x="{x:.1f}" y="{y - 11}" width="{max(width, 1):.1f}" height="14" '
                f'fill="{color}"/>\n'
            )
    height = bottom + 2 * _ROW
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" '
        'style="font-family:sans-serif;font-size:12px">'
        f'<rect width="{_WIDTH}" height="{height}" fill="white"/>\n{"".join(parts)}</svg>\n'
    )


def _round(span: float) -> float:
    # the largest of 0.1, 0.2, 0.5, 1, 2 … up to a quarter of ``span``, or 0.1
    steps = [mantissa * 10.0**power for power in range(-1, 7) for mantissa in (1, 2, 5)]
    return max((step for step in steps if step <= span / 4), default=steps[0])


def _map(replay: Replay, color_of: Callable[[str], str]) -> Iterator[str]:
    areas = [
        (rule.name, rule.condition)
        for rule in replay.file.rules
        if isinstance(rule.condition, Near | Count)
    ]
    xs = [x for track in replay.tracks.values() for x, _ in track]
    ys = [y for track in replay.tracks.values() for _, y in track]
    for _, condition in areas:
        around = condition.stop if isinstance(condition, Near) else condition.radius
        low_x, low_y, high_x, high_y = condition.bounds
        xs += (low_x - around, high_x + around)
        ys += (low_y - around, high_y + around)
    # positions in metres become positions in the picture, where y grows downwards
    left, top = min(xs, default=0.0), max(ys, default=0.0)
    width, height = max(xs, default=1.0) - left, top - min(ys, default=0.0)
    factor = min((_WIDTH - 2 * _EDGE) / (width or 1), (_MAP - 2 * _EDGE) / (height or 1))

    def at(x: float, y: float) -> tuple[float, float]:
        return _EDGE + (x - left) * factor, _EDGE + (top - y) * factor

    labels: dict[tuple[float, float], list[str]] = {}
    for name, condition in areas:
        corners = [at(*corner) for corner in condition.corners]
        x, y = corners[0]
        labels.setdefault((x, y), []).append(name)
        if len(corners) > 1:
            points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
            yield f'<polygon points="{points}" fill="#0001" stroke="#666"/>\n'
            continue
        if isinstance(condition, Near):
            radii = [condition.start, condition.stop]
        else:
            radii = [condition.radius]
        for radius, dash in zip(radii, ("none", "6 4"), strict=False):
            yield (
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius * factor:.1f}" '
                f'fill="#0001" stroke="#666" stroke-dasharray="{dash}"/>\n'
            )
    for (x, y), names in labels.items():
        for line, name in enumerate(names):
            yield _text(x + 4, y + 14 * line, name, "#444")
    for (_, entity), track in replay.tracks.items():
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (at(*point) for point in track))
        color = color_of(entity)
        yield f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="2"/>\n'
        x, y = at(*track[0])
        yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{color}"/>\n'
        yield _text(x + 6, y - 6, entity, color)
    metres = _round(width or height or 1)
    length = metres * factor
    yield f'<path d="M{_EDGE} {_MAP - 12}h{length:.1f}" stroke="black" stroke-width="3"/>\n'
    yield _text(_EDGE, _MAP - 18, f"{metres:g} m", "black")


def _text(x: float, y: float, text: str, color: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{color}">{escape(text)}</text>\n'


# ---- the replay, and its output ----

# How many messages the detector gets at a time; the number does not change the events.
_TOGETHER = 1_000
_MOST_LISTED = 8  # entities
_TRACK_M = 0.5  # the least distance in metres between two points of an entity's track in the plot


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
    heard: set[tuple[str, str]] = field(default_factory=set)  # sources with their entities

    def without_events(self) -> Iterator[tuple[str, str]]:
        """Yield each rule that had no event, and what its entities did instead."""
        for rule in self.file.rules:
            if any(event.rule == rule.name for event, _ in self.events):
                continue
            seen = sorted({who[1] for who in self.heard if who[0] in rule.sources})
            listed = f"entities seen: {', '.join(seen[:_MOST_LISTED]) or 'none'}"
            listed += f" and {more} more" if (more := len(seen) - _MOST_LISTED) > 0 else ""
            fitting = [who for who in self.heard if who[0] in rule.sources and rule.takes(who)]
            if not rule.sources:
                yield rule.name, "the recording is outside of its hours"
            elif not fitting:
                yield rule.name, f"{listed}; none matches {' '.join(rule.entities)}"
            elif isinstance(rule.condition, Near | Count):
                away, entity = min(
                    (rule.condition.distance(*point), who[1])
                    for who in fitting
                    for point in self.tracks[who]
                )
                limits = f"start: {rule.condition.start:g}, dwell: {rule.dwell}"
                yield rule.name, f"nearest: {entity} at {away:,.0f} m ({limits})"
            else:
                yield rule.name, f"{listed}; its condition never held for {rule.dwell}"


def replayed(name: str, bag: RecordedBag, file: RuleFile) -> Replay:
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
        replay.heard.add(observation.who)
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
    ranks = {"second": 0, "change": 0, "rule": 0, "entities": 0, "why": 2, "demand": 1}
    columns = [Column(key, key.capitalize(), rank) for key, rank in ranks.items()]
    rows = [
        (
            [f"{event.at - replay.span[0]:.1f}"],
            ["start" if event.starts else "stop"],
            [event.rule],
            event.subjects,
            [event.why],
            [] if goal is None else [goal.id],
        )
        for event, goal in replay.events
    ]
    summary = (
        f"{replay.messages} messages on {len(replay.topics)} topics in "
        f"{replay.span[1] - replay.span[0]:.1f} s; events that have not stopped: "
        f"{len(replay.lasting)}"
    )
    silent = [f"rule '{rule}' had no event: {why}" for rule, why in replay.without_events()]
    formats.show(output, as_data(replay), [Table(columns, rows), *silent, summary])
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
                "action": None if goal is None else goal.action,
                "goal": None if goal is None else goal.document,
            }
            for event, goal in replay.events
        ],
        "without_events": [{"rule": rule, "reason": why} for rule, why in replay.without_events()],
        "lasting": [
            {"rule": rule, "entities": list(subjects)} for rule, subjects in replay.lasting
        ],
    }


def _time(seconds: float) -> str:
    moment = datetime.fromtimestamp(seconds, timezone.utc)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
