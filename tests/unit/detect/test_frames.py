"""Positions in any frame of the tree that /tf and /tf_static tell of are the map's."""

from __future__ import annotations

from itertools import pairwise
from math import cos, hypot, pi, sin
from types import SimpleNamespace as Message
from typing import Any

import pytest
from demandops.detect import rule_file
from demandops.detect.message_reader import FrameTree, MessageReader, NoTransform, Unreadable
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.detection import POSE, rule, text_of

Point = tuple[float, float, float]
Turn = tuple[float, float, float, float]  # x, y, z, w
STRAIGHT: Turn = (0.0, 0.0, 0.0, 1.0)


def turn(degrees: float, *axis: float) -> Turn:
    half = degrees * pi / 360
    x, y, z = (part * sin(half) / hypot(*axis) for part in axis)
    return x, y, z, cos(half)


def told(*links: tuple[str, str, Point, Turn]) -> Message:
    """Return a message of /tf with links of a child, its parent, and where the child is in it."""
    return Message(
        transforms=[
            Message(
                header=Message(frame_id=parent),
                child_frame_id=child,
                transform=Message(
                    translation=Message(**dict(zip("xyz", moved, strict=True))),
                    rotation=Message(**dict(zip("xyzw", by, strict=True))),
                ),
            )
            for child, parent, moved, by in links
        ]
    )


def tree(*links: tuple[str, str, Point, Turn], static: bool = True, at: float = 0) -> FrameTree:
    frames = FrameTree("map")
    frames.hear(told(*links), static, at)
    return frames


def near(point: Point) -> Any:
    return pytest.approx(point, abs=1e-9)


def test_a_point_goes_up_to_the_map_by_each_link() -> None:
    left = turn(90, 0, 0, 1)
    frames = tree(("odom", "map", (100, 50, 0), left), ("base", "odom", (10, 0, 1), left))
    assert frames.on_map("odom", (1, 0, 0), 0) == near((100, 51, 0))
    assert frames.on_map("base", (1, 0, 0), 0) == near((99, 60, 1))


def test_the_map_need_not_be_the_root() -> None:
    frames = tree(
        ("map", "utm", (1000, 2000, 0), turn(90, 0, 0, 1)),
        ("car", "utm", (1000, 2005, 0), STRAIGHT),
    )
    assert frames.on_map("car", (0, 0, 0), 0) == near((5, 0, 0))
    assert frames.on_map("utm", (1000, 2000, 0), 0) == near((0, 0, 0))


def test_what_a_camera_sees_ahead_is_ahead_on_the_map() -> None:
    # of a camera, z is ahead and x is to the right
    frames = tree(("camera", "map", (0, 0, 2), (-0.5, 0.5, -0.5, 0.5)))
    assert frames.on_map("camera", (3, 0, 20), 0) == near((20, -3, 2))


@st.composite
def links(draw: st.DrawFn) -> tuple[Point, Turn]:
    number = st.floats(-1000, 1000)
    axis = draw(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: hypot(*axis) > 0.01))
    scale = draw(st.floats(0.5, 2))  # a rotation that is not quite a unit quaternion
    by = turn(draw(number), *axis)
    return draw(st.tuples(number, number, number)), tuple(scale * part for part in by)


@given(st.lists(links(), min_size=1, max_size=5), st.tuples(*[st.floats(-100, 100)] * 3))
@examples(100)
def test_the_way_down_undoes_the_way_up(chain: list[tuple[Point, Turn]], point: Point) -> None:
    """The map is once the root of a chain and once its end: one way inverts the other."""
    frames = ["map", *(f"f{number}" for number in range(len(chain)))]
    up = tree(
        *(
            (child, parent, *link)
            for (parent, child), link in zip(pairwise(frames), chain, strict=True)
        )
    )
    frames = ["end", *frames[1:-1], "map"]
    down = tree(
        *(
            (child, parent, *link)
            for (parent, child), link in zip(pairwise(frames), chain, strict=True)
        )
    )
    there = up.on_map(f"f{len(chain) - 1}", point, 0)
    assert down.on_map("end", there, 0) == pytest.approx(point, abs=1e-6)


POSES = {"cars": {"topic": "/cars/{entity}/pose", "type": POSE, "timeout": "3s"}}
NEAR = rule("near", near={"source": "cars", "point": {"x": 0, "y": 0}, "start": 5, "stop": 6})


def pose(frame: str, x: float = 1.0) -> Message:
    point = Message(position=Message(x=x, y=2.0, z=3.0))
    return Message(header=Message(frame_id=frame), pose=point)


def reader(frames: FrameTree, **source: Any) -> MessageReader:
    cars = {"cars": POSES["cars"] | source}
    text = text_of(NEAR, sources=cars, map={"frame": "map"})
    return MessageReader(rule_file.read(text, "rules.yaml"), "cars", frames)


def test_a_position_is_on_the_map_or_is_left_out() -> None:
    reads = reader(frames := FrameTree("map"))
    for frame in ("map", "/map", ""):
        assert reads.observation(pose(frame), "car", 7).position == (1, 2)
    why = "in the frame 'odom' are left out, because nothing on /tf or /tf_static leads from '{}'"
    with pytest.raises(NoTransform, match=why.format("odom")):
        reads.observation(pose("odom"), "car", 7)
    frames.hear(told(("odom", "base", (10, 0, 0), STRAIGHT)), False, 7)
    with pytest.raises(NoTransform, match=why.format("base") + " to 'map'"):
        reads.observation(pose("odom"), "car", 7)
    frames.hear(told(("/base", "/map", (0, 10, 0), STRAIGHT)), True, 7)
    assert reads.observation(pose("odom"), "car", 7).position == near((11, 12))
    assert reads.observation(pose("odom"), "car", 10).position == near((11, 12))
    with pytest.raises(NoTransform, match=why.format("odom")):  # silent for longer than its source
        reads.observation(pose("odom"), "car", 10.1)


def test_fields_of_any_message_may_have_the_frame_and_the_height() -> None:
    frames = tree(("camera", "map", (0, 0, 0), (-0.5, 0.5, -0.5, 0.5)))
    fields = {"type": "a_msgs/msg/A", "x": "at[0]", "y": "at[1]", "z": "at[2]", "frame": "of"}
    seen = reader(frames, **fields).observation(Message(at=[3, 0, 20], of="camera"), "car", 0)
    assert seen.position == near((20, -3))


def test_a_frame_that_names_the_entity_is_not_where_it_is() -> None:
    reads = reader(FrameTree("map"), topic="/poses", entity="header.frame_id")
    assert reads.observation(pose("car7"), "", 7).position == (1, 2)


def test_transforms_of_no_use_change_nothing() -> None:
    frames = tree(("odom", "map", (1, 0, 0), STRAIGHT))
    nothing, broken, wide = (0.0, 0.0, 0.0, 0.0), (float("nan"), 0, 0), (1e308, 0, 0)
    frames.hear(
        told(("odom", "map", (2, 0, 0), nothing), ("odom", "map", broken, STRAIGHT)), True, 0
    )
    assert frames.on_map("odom", (0, 0, 0), 0) == (1, 0, 0)
    frames.hear(told(("a", "b", (0, 0, 0), STRAIGHT), ("b", "a", (0, 0, 0), STRAIGHT)), True, 0)
    with pytest.raises(NoTransform):  # a circle
        frames.on_map("a", (0, 0, 0), 0)
    frames.hear(told(("odom", "map", wide, STRAIGHT)), True, 0)
    with pytest.raises(Unreadable, match="the position is more than"):
        reader(frames).observation(pose("odom", 1e308), "car", 0)
