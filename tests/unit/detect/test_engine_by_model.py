"""The engine reports the same events as a simple model without an index."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product
from math import hypot
from typing import Any

from demandops.detect.event_engine import Observation
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.detection import Run, rule

TICK = 0.5
TIMEOUTS = {"cars": 3.0, "bikes": 2.0}
POINT = {"x": 0, "y": 0}
SQUARE = [{"x": x, "y": y} for x, y in ((10, 10), (30, 10), (30, 30), (10, 30))]
NAMES = {"cars": ("a", "b", "c", "d"), "bikes": ("a", "e")}
RULES = [
    rule("near", near={"source": "cars", "point": POINT, "start": 10, "stop": 14}),
    rule("late", near={"source": "cars", "polygon": SQUARE, "start": 0, "stop": 3}, dwell="1s"),
    rule("some", near={"source": "bikes", "point": POINT, "start": 9, "stop": 30}, entities=["e"]),
    rule("pair", together={"source": "cars", "start": 5, "stop": 8}),
    rule("both", together={"source": "cars", "other": "bikes", "start": 6, "stop": 7}, dwell="2s"),
    rule("duo", together={"source": "cars", "start": 6, "stop": 9}, entities=["a", "b"]),
    rule(
        "mix", together={"source": "cars", "other": "bikes", "start": 4, "stop": 9}, entities=["b"]
    ),
    rule("full", count={"source": "cars", "point": POINT, "radius": 20, "start": 3, "stop": 1}),
]


class Model:
    """A model of the engine; at each message it compares all entities with each other."""

    def __init__(self) -> None:
        self.at: dict[tuple[str, str], tuple[float, float]] = {}
        self.heard: dict[tuple[str, str], float] = {}
        self.waiting: dict[tuple[str, tuple[str, ...]], float] = {}
        self.lasting: set[tuple[str, tuple[str, ...]]] = set()
        self.events: list[tuple[float, str, tuple[str, ...], bool]] = []

    def pass_time(self, now: float) -> None:
        dwell = {each["name"]: float(each.get("dwell", "0s")[:-1]) for each in RULES}
        for key, since in [*self.waiting.items()]:
            if now >= since + dwell[key[0]]:
                del self.waiting[key]
                self.lasting.add(key)
                self.events.append((now, *key, True))
        for who, heard in [*self.heard.items()]:
            if now >= heard + TIMEOUTS[who[0]]:
                del self.heard[who], self.at[who]
                self.compare(now)

    def hear(self, now: float, source: str, entity: str, x: float, y: float) -> None:
        self.heard[source, entity], self.at[source, entity] = now, (x, y)
        self.compare(now)

    def compare(self, now: float) -> None:
        found = {key: levels for key, *levels in self.levels()}
        for key in {*self.waiting, *self.lasting, *found}:
            starts, stops = found.get(key, (False, True))
            if stops and key in self.lasting:
                self.lasting.discard(key)
                self.events.append((now, *key, False))
            elif stops:
                self.waiting.pop(key, None)
            elif starts and key not in self.lasting and key not in self.waiting:
                if key[0] in ("late", "both"):
                    self.waiting[key] = now
                else:
                    self.lasting.add(key)
                    self.events.append((now, *key, True))

    def levels(self) -> Iterator[tuple[Any, bool, bool]]:
        """Yield (key, starts, stops): whether the positions fit an event's start, and its stop."""
        inside = 0
        for (source, entity), (x, y) in self.at.items():
            away = hypot(x, y)
            if source == "cars":
                inside += away <= 20
                yield ("near", (entity,)), away <= 10, away > 14
                to_square = hypot(max(10 - x, 0, x - 30), max(10 - y, 0, y - 30))
                yield ("late", (entity,)), to_square <= 0, to_square > 3
            elif entity == "e":
                yield ("some", (entity,)), away <= 9, away > 30
        cars = sorted(name for source, name in self.at if source == "cars")
        bikes = sorted(name for source, name in self.at if source == "bikes")
        for one, other in combinations(cars, 2):
            away = self.between(("cars", one), ("cars", other))
            yield ("pair", (one, other)), away <= 5, away > 8
            if (one, other) == ("a", "b"):
                yield ("duo", (one, other)), away <= 6, away > 9
        for one, other in product(cars, bikes):
            away = self.between(("cars", one), ("bikes", other))
            yield ("both", (one, other)), away <= 6, away > 7
            if one == "b":
                yield ("mix", (one, other)), away <= 4, away > 9
        yield ("full", ()), inside >= 3, inside <= 1

    def between(self, one: tuple[str, str], other: tuple[str, str]) -> float:
        (x1, y1), (x2, y2) = self.at[one], self.at[other]
        return hypot(x1 - x2, y1 - y2)


coordinate = st.one_of(st.integers(0, 9), st.integers(-4, 34))
who = st.sampled_from([(source, name) for source, names in NAMES.items() for name in names])
moment = st.tuples(st.integers(0, 5), st.lists(st.tuples(who, coordinate, coordinate), max_size=6))


@examples(150)
@given(st.lists(moment, max_size=12), st.lists(st.booleans(), min_size=12, max_size=12))
def test_the_engine_gives_the_events_of_the_model(
    moments: list[tuple[int, list[Any]]], splits: list[bool]
) -> None:
    model, run, told = Model(), Run(*RULES), []
    now, pending = 0.0, []
    for (ticks, heard), split in zip(moments, splits, strict=False):
        for _ in range(ticks):
            now += TICK
            model.pass_time(now)
        for (source, entity), x, y in heard:
            model.hear(now, source, entity, x, y)
            pending.append(Observation(source, entity, now, (float(x), float(y))))
        if split:
            told += run.step(now, *pending)
            pending = []
    told += run.step(now, *pending)
    events = [(event.at, event.rule, event.subjects, event.starts) for event in told]
    assert sorted(events) == sorted(model.events)
    assert run.state.lasting == model.lasting
