"""The observations that messages become: positions in degrees or in any frame, and values."""

from __future__ import annotations

from itertools import pairwise, product
from math import cos, hypot, pi, radians, sin
from operator import itemgetter
from types import SimpleNamespace as Message
from typing import Any

import pytest
from demandops.detect import rule_file
from demandops.detect.condition import entity_in
from demandops.detect.message_reader import FrameTree, MessageReader, NoTransform, Unreadable
from demandops.detect.rule_file import POSITIONS
from hypothesis import given
from hypothesis import strategies as st

from tests.kit import plain_yaml
from tests.kit.chance import examples
from tests.kit.detection import POSE, rule, text_of

Place = tuple[float, float]
Point = tuple[float, float, float]
Turn = tuple[float, float, float, float]  # x, y, z, w
STRAIGHT: Turn = (0.0, 0.0, 0.0, 1.0)
HOT = {"source": "all", "field": "engine.heat[1]", "above": 90, "stop": 80}
UNKNOWN = "a_msgs/msg/A"
TABLES = plain_yaml.beside(__file__)


def reader(
    type_name: str = UNKNOWN, *, frames: FrameTree | None = None, **fields: Any
) -> MessageReader:
    """Return a reader of a source; ``map`` and ``rules`` belong to its file."""
    file = {"map": fields.pop("map")} if "map" in fields else {}
    rules = fields.pop("rules", [])
    source = {"topic": "/all/{entity}", "type": type_name, "timeout": "3s"} | fields
    text = text_of(*rules, sources={"all": source}, **file)
    return MessageReader(rule_file.read(text, "rules.yaml"), "all", frames)


def place(reads: MessageReader, message: Message, at: float = 7, entity: str = "car") -> Any:
    """Return the position on the map that a message tells, or None."""
    seen = reads.observation(message, entity, at)
    return seen and seen.position


# ---- fields of messages ----


def message(x: object = 1, **more: Any) -> Message:
    """Return a message that has the position fields of all known types."""
    point = Message(position=Message(x=x, y=2))
    pose = Message(position=Message(x=x, y=2), pose=point)
    state = Message(continuous_state=[x, 2])
    return Message(pose=pose, state=state, engine=Message(heat=[20, b"\x5f"]), **more)


@pytest.mark.parametrize("type_name", [name for name, p in POSITIONS.items() if not p.in_degrees])
def test_the_position_of_known_types_is_found(type_name: str) -> None:
    seen = reader(type_name, rules=[rule("hot", threshold=HOT)]).observation(message(), "car", 7)
    assert (seen.who, seen.at, seen.position) == (("all", "car"), 7, (1, 2))
    assert seen.values == {"engine.heat[1]": 95}


def test_a_field_may_name_the_entity_of_a_topic_that_many_share() -> None:
    shared = reader(topic="/all", entity="header.frame_id")
    seen = shared.observation(message(header=Message(frame_id="/car7")), "", 7)
    assert (seen.entity, seen.position) == ("car7", None)
    with pytest.raises(Unreadable, match="'car 7; rm' is not a name of an entity"):
        shared.observation(message(header=Message(frame_id="car 7; rm")), "", 7)


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (message(float("nan")), "nan is not a finite number"),
        (message(float("-inf")), "-inf is not a finite number"),
        (message("here"), "'here' is not a number"),
        (message(1e10), "the position is more than 1e+09 m from the origin"),
        (Message(engine=Message(heat=[1])), "the message has no field "),
    ],
)
def test_a_message_of_no_use_is_left_out(sent: Message, why: str) -> None:
    with pytest.raises(Unreadable) as caught:
        reader(POSE).observation(sent, "car", 7)
    assert str(caught.value).startswith(why)


@pytest.mark.parametrize(("pattern", "topic", "entity"), TABLES["entities"])
def test_an_entity_is_one_part_of_a_topic(pattern: str, topic: str, entity: str | None) -> None:
    assert entity_in(pattern, topic) == entity


# ---- degrees, from satellites or in ETSI's messages, are metres on the rules' map ----


AACHEN = {"latitude": 50.7784, "longitude": 6.0606}
METRES_OF_A_DEGREE = 111_200  # of a great circle, to half a percent
FIX, CAM = "sensor_msgs/msg/NavSatFix", "etsi_its_cam_msgs/msg/CAM"


def fix(latitude: float, longitude: float, status: int = 0) -> Message:
    return Message(latitude=latitude, longitude=longitude, status=Message(status=status))


def cam(latitude: int, longitude: int) -> Message:
    position = Message(latitude=Message(value=latitude), longitude=Message(value=longitude))
    container = Message(reference_position=position)
    return Message(cam=Message(cam_parameters=Message(basic_container=container)))


@given(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
@examples(100)
def test_degrees_are_metres_to_the_east_and_the_north(north: float, east: float) -> None:
    degrees = AACHEN["latitude"] + north, AACHEN["longitude"] + east
    x, y = place(reader(FIX, map=AACHEN), fix(*degrees))
    right = METRES_OF_A_DEGREE * cos(radians(degrees[0])) * east
    assert hypot(x - right, y - METRES_OF_A_DEGREE * north) <= 1 + hypot(x, y) / 100
    tenths = [round(each * 1e7) for each in degrees]  # ETSI's units, to a centimetre
    assert place(reader(CAM, map=AACHEN), cam(*tenths)) == pytest.approx((x, y), abs=0.02)
    named = reader(map=AACHEN, latitude="lat", longitude="at.lon", scale=1e-7)
    other = Message(lat=tenths[0], at=Message(lon=tenths[1]))
    assert place(named, other) == pytest.approx((x, y), abs=0.02)


def test_a_reference_system_has_its_own_origin() -> None:
    # the middle of UTM's zone 32 is 500 km to the west of its meridian's coordinate, by definition
    system = {"crs": "EPSG:25832", "x": 500_000.0, "y": 5_500_000.0, "datum": "EPSG:4258"}
    utm = reader(FIX, map=system)
    x, y = place(utm, fix(50.0, 9.0))
    assert x == pytest.approx(0, abs=0.001)
    assert place(utm, fix(50.1, 9.0)) == pytest.approx((0, y + METRES_OF_A_DEGREE / 10), abs=50)


def test_a_position_that_is_not_known_counts_as_silence() -> None:
    named = reader(FIX, map=AACHEN, latitude="latitude", longitude="longitude")
    for reads, status in product((reader(FIX, map=AACHEN), named), (-1, -2)):
        assert place(reads, fix(0.0, 0.0, status)) is None
    trusts = reader(FIX, map=AACHEN, unavailable={"status.status": -1})
    assert place(trusts, fix(*AACHEN.values(), status=-2)) == (0, 0)
    for reads in (reader(name, map=AACHEN) for name in (CAM, "etsi_its_cam_ts_msgs/msg/CAM")):
        assert place(reads, cam(900_000_001, 1_800_000_001)) is None
        assert place(reads, cam(507_784_000, 1_800_000_001)) is None
    own = reader(x="x", y="y", unavailable={"quality": 0})
    assert place(own, Message(x=1, y=2, quality=0)) is None
    assert place(own, Message(x=1, y=2, quality=1)) == (1, 2)


@pytest.mark.parametrize("degrees", [(91, 0), (0, -181), (90.1, 6.0)])
def test_a_place_that_the_map_has_not_is_left_out(degrees: Place) -> None:
    with pytest.raises(Unreadable, match="is not on the map"):
        place(reader(FIX, map=AACHEN), fix(*degrees))


# ---- positions in any frame of the tree that /tf and /tf_static tell of are the map's ----


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


def near(point: Place | Point) -> Any:
    return pytest.approx(point, abs=1e-9)


@pytest.mark.parametrize("case", TABLES["frames"], ids=itemgetter("is"))
def test_a_point_of_a_frame_is_on_the_map(case: dict[str, Any]) -> None:
    links = [(child, parent, moved, turn(*by)) for child, parent, moved, by in case["links"]]
    for frame, point, wanted in case["points"]:
        assert tree(*links).on_map(frame, point, 0) == near(wanted)


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
    between = [f"f{number}" for number in range(len(chain) - 1)]
    up, down = (
        tree(*((child, up, *link) for (up, child), link in zip(pairwise(way), chain, strict=True)))
        for way in (["map", *between, "end"], ["end", *between, "map"])
    )
    there = up.on_map("end", point, 0)
    assert down.on_map("end", there, 0) == pytest.approx(point, abs=1e-6)


def pose(frame: str, x: float = 1.0) -> Message:
    point = Message(position=Message(x=x, y=2.0, z=3.0))
    return Message(header=Message(frame_id=frame), pose=point)


def on_map(frames: FrameTree, **source: Any) -> MessageReader:
    return reader(source.pop("type", POSE), frames=frames, map={"frame": "map"}, **source)


def test_a_position_is_on_the_map_or_is_left_out() -> None:
    reads = on_map(frames := FrameTree("map"))
    for frame in ("map", "/map", ""):
        assert place(reads, pose(frame)) == (1, 2)
    why = "in the frame 'odom' are left out, because nothing on /tf or /tf_static leads from '{}'"
    with pytest.raises(NoTransform, match=why.format("odom")):
        place(reads, pose("odom"))
    frames.hear(told(("odom", "base", (10, 0, 0), STRAIGHT)), False, 7)
    with pytest.raises(NoTransform, match=why.format("base") + " to 'map'"):
        place(reads, pose("odom"))
    frames.hear(told(("/base", "/map", (0, 10, 0), STRAIGHT)), True, 7)
    assert place(reads, pose("odom")) == place(reads, pose("odom"), 10) == near((11, 12))
    with pytest.raises(NoTransform, match=why.format("odom")):  # silent for longer than its source
        place(reads, pose("odom"), 10.1)


def test_fields_of_any_message_may_have_the_frame_and_the_height() -> None:
    frames = tree(("camera", "map", (0, 0, 0), (-0.5, 0.5, -0.5, 0.5)))
    fields = {"type": UNKNOWN, "x": "at[0]", "y": "at[1]", "z": "at[2]", "frame": "of"}
    seen = place(on_map(frames, **fields), Message(at=[3, 0, 20], of="camera"))
    assert seen == near((20, -3))


def test_a_frame_that_names_the_entity_is_not_where_it_is() -> None:
    reads = on_map(FrameTree("map"), topic="/poses", entity="header.frame_id")
    assert place(reads, pose("car7"), entity="") == (1, 2)


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
        place(on_map(frames), pose("odom", 1e308), 0)
