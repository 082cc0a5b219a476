"""The events that each kind of rule gives."""

from __future__ import annotations

from datetime import datetime, timezone

from demandops.detect.observations import Observation

from tests.kit.detection import POSE, SOURCES, Run, at, rule

POINT = {"x": 0, "y": 0}
NEAR = {"source": "cars", "point": POINT, "start": 84, "stop": 90}


def test_nearness_starts_and_stops_at_its_own_distance() -> None:
    run = Run(rule("near", near=NEAR))
    assert run.told(1, at(1, "a", 84.1)) == []
    assert run.told(2, at(2, "a", 84)) == [("near", "a", "start", 2)]
    assert run.told(3, at(3, "a", 90)) == []
    assert run.told(4, at(4, "a", 90.1)) == [("near", "a", "stop", 4)]
    assert run.told(5, at(5, "a", 89)) == []


def test_an_event_says_what_has_happened() -> None:
    run = Run(rule("near", near=NEAR))
    (event,) = run.step(1, at(1, "a", 30, 40))
    assert event.why == "a is 50.0 m from the area"
    assert event.values == {"rule": "near", "entity": "a", "x": 30, "y": 40, "distance": 50}
    (event,) = run.step(9)
    assert (event.why, event.at) == ("a has been silent for 3 s", 4)


def test_a_polygon_with_a_notch_is_left_there() -> None:
    corners = [(0, 0), (100, 0), (100, 100), (50, 20), (0, 100)]
    polygon = [{"x": x, "y": y} for x, y in corners]
    run = Run(rule("in", near={"source": "cars", "polygon": polygon, "start": 0, "stop": 5}))
    assert run.told(1, at(1, "a", 50, 10)) == [("in", "a", "start", 1)]
    assert run.told(2, at(2, "a", 50, 24)) == []
    assert run.told(3, at(3, "a", 50, 60)) == [("in", "a", "stop", 3)]


def test_a_dwell_time_goes_on_between_start_and_stop_and_ends_beyond() -> None:
    run = Run(rule("stays", near=NEAR, dwell="2s"))
    assert run.told(1, at(1, "a", 80), at(1, "b", 80)) == []
    assert run.told(2.5, at(2, "a", 89), at(2.5, "b", 95)) == []
    assert run.told(4, at(4, "b", 80)) == [("stays", "a", "start", 3)]
    assert run.told(5) == [("stays", "a", "stop", 5)], "a was last heard at 2; b must dwell again"
    assert run.told(6) == [("stays", "b", "start", 6)]


def test_a_threshold_of_a_field_has_hysteresis_in_both_directions() -> None:
    low = {"source": "batteries", "field": "percentage", "below": 0.2, "stop": 0.3}
    hot = {"source": "batteries", "field": "temperature", "above": 60, "stop": 50}
    run = Run(rule("low", threshold=low), rule("hot", threshold=hot))

    def told(time: float, percentage: float, temperature: float) -> object:
        values = {"percentage": percentage, "temperature": temperature}
        return run.told(time, Observation("batteries", "a", time, None, values))

    assert told(1, 0.2, 60) == []
    assert told(2, 0.19, 61) == [("low", "a", "start", 2), ("hot", "a", "start", 2)]
    assert told(3, 0.29, 51) == []
    assert told(4, 0.3, 50) == [("low", "a", "stop", 4), ("hot", "a", "stop", 4)]


def test_a_schedule_follows_the_clock_of_its_zone_and_may_end_on_the_next_day() -> None:
    def on(day: int, hour: int, minute: int = 0) -> float:
        return datetime(2026, 3, day, hour, minute, tzinfo=timezone.utc).timestamp()

    night = {"days": ["sat"], "start": "22:00", "stop": "04:30", "zone": "Europe/Berlin"}
    run = Run(rule("night", schedule=night), now=on(27, 12))  # a Friday
    assert run.told(on(28, 20, 59)) == []
    assert run.told(on(28, 21)) == [("night", "", "start", on(28, 21))]
    # the clocks go forward at 01:00 UTC
    assert run.told(on(29, 12)) == [("night", "", "stop", on(29, 2, 30))]
    assert run.told(on(30, 23)) == []


def test_after_a_gap_one_step_tells_each_change_at_its_own_time() -> None:
    """A bag that is replayed may have such a gap."""
    sources = {**SOURCES, "slow": {"topic": "/slow/{entity}", "type": POSE, "timeout": "10m"}}
    rules = (
        rule("hour", schedule={"start": "00:01", "stop": "00:02"}),
        rule("late", schedule={"start": "00:03", "stop": "00:04"}, dwell="5s"),
        rule("near", near={**NEAR, "source": "slow"}),
    )
    run = Run(*rules, sources=sources)
    assert run.told(1, at(1, "a", 0, source="slow")) == [("near", "a", "start", 1)]
    assert run.told(1000) == [
        ("hour", "", "start", 60),
        ("hour", "", "stop", 120),
        ("late", "", "start", 185),
        ("late", "", "stop", 240),
        ("near", "a", "stop", 601),
    ]


def test_events_from_before_a_start_go_on_if_their_entities_come_back_in_time() -> None:
    run = Run(
        rule("near", near=NEAR),
        rule("pair", together={"source": "cars", "start": 10, "stop": 20}),
        rule("full", count={"source": "cars", "point": POINT, "radius": 84, "start": 2, "stop": 1}),
    )
    keys = [("near", ("a",)), ("near", ("b",)), ("pair", ("a", "b")), ("full", ())]
    run.state = run.engine.start(0, [*keys, ("gone", ("a",)), ("full", ("a",))], settle_s=5)
    assert run.state.lasting == {*keys}
    assert run.told(1, at(1, "a", 89)) == [], "the event must last while b may still come"
    assert run.told(4.9, at(3.5, "a", 89), at(4.5, "c", 200)) == []
    assert run.told(5) == [
        ("full", "", "stop", 5),
        ("near", "b", "stop", 5),
        ("pair", "a b", "stop", 5),
    ]
    assert run.told(6, at(6, "a", 91)) == [("near", "a", "stop", 6)]


def test_an_entity_that_reports_seldom_is_awaited_after_a_start_for_its_timeout() -> None:
    slow = {"topic": "/slow/{entity}", "type": POSE, "timeout": "60s"}
    counted = {"source": "slow", "point": POINT, "radius": 84, "start": 1, "stop": 0}
    run = Run(
        rule("near", near={**NEAR, "source": "slow"}),
        rule("quick", near=NEAR),
        rule("some", count=counted),
        sources={**SOURCES, "slow": slow},
    )
    held = [("near", ("a",)), ("near", ("b",)), ("quick", ("c",)), ("some", ())]
    run.state = run.engine.start(0, held, settle_s=10)
    assert run.told(59) == [("quick", "c", "stop", 10)]
    assert run.told(59.5, at(59.5, "a", 89, source="slow")) == []
    assert run.told(70, at(70, "a", 80, source="slow")) == [
        ("some", "", "stop", 60),
        ("near", "b", "stop", 60),
        ("some", "", "start", 70),
    ]


def test_an_entity_that_a_rule_on_pairs_is_not_for_may_fall_silent() -> None:
    run = Run(
        rule("pair", together={"source": "cars", "start": 5, "stop": 8}, entities=["car*"]),
        rule("near", near=NEAR),
    )
    assert run.told(1, at(1, "car1", 0), at(1, "tram", 1))[1:] == [("near", "tram", "start", 1)]
    assert run.told(4)[1:] == [("near", "tram", "stop", 4)]


def test_a_clock_that_is_set_ends_nothing() -> None:
    for seconds in (-3600, 3600):
        run = Run(rule("near", near=NEAR))
        run.step(10_000, at(10_000, "a", 0))
        run.state = run.state.shifted(seconds)
        assert run.told(10_002 + seconds) == []
        assert run.told(10_003 + seconds) == [("near", "a", "stop", 10_003 + seconds)]


def test_a_schedule_follows_a_clock_that_is_set() -> None:
    run = Run(rule("hours", schedule={"start": "07:00", "stop": "20:00"}))
    assert run.told(6.0 * 3600) == []
    run.state = run.state.shifted(3 * 3600)
    assert run.told(9.0 * 3600 + 1) == [("hours", "", "start", 9.0 * 3600)]


def test_a_step_leaves_the_state_before_as_it_was() -> None:
    run = Run(
        rule("near", near=NEAR), rule("pair", together={"source": "cars", "start": 5, "stop": 8})
    )
    run.step(1, at(1, "a", 0), at(1, "b", 1))
    before = run.state
    first = run.engine.step(before, [at(2, "a", 95)], 2)
    assert run.engine.step(before, [at(2, "a", 95)], 2) == first
    assert len(first[1]) == 2
