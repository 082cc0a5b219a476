"""Positions in degrees, from satellites or in ETSI's messages, are metres on the rules' map."""

from __future__ import annotations

from math import cos, hypot, radians
from types import SimpleNamespace as Message
from typing import Any

import pytest
from demandops.detect import rule_file
from demandops.detect.event_engine import Observation
from demandops.detect.message_reader import MessageReader, Unreadable
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.detection import rule, text_of

AACHEN = {"latitude": 50.7784, "longitude": 6.0606}
METRES_OF_A_DEGREE = 111_200  # of a great circle, to half a percent
FIX, CAM = "sensor_msgs/msg/NavSatFix", "etsi_its_cam_msgs/msg/CAM"


def reader(type_name: str, map: dict[str, Any] = AACHEN, **fields: Any) -> MessageReader:
    source = {"topic": "/all/{entity}", "type": type_name} | fields
    near = {"source": "all", "point": {"x": 0, "y": 0}, "start": 84, "stop": 84}
    text = text_of(rule("near", near=near), sources={"all": source}, map=map)
    return MessageReader(rule_file.read(text, "rules.yaml"), "all")


def fix(latitude: float, longitude: float, status: int = 0) -> Message:
    return Message(latitude=latitude, longitude=longitude, status=Message(status=status))


def cam(latitude: int, longitude: int) -> Message:
    position = Message(latitude=Message(value=latitude), longitude=Message(value=longitude))
    container = Message(reference_position=position)
    return Message(cam=Message(cam_parameters=Message(basic_container=container)))


def heard(reading: MessageReader, message: Message) -> tuple[float, float] | None:
    seen: Observation | None = reading.observation(message, "car", 7)
    return seen and seen.position


@given(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
@examples(100)
def test_degrees_are_metres_to_the_east_and_the_north(north: float, east: float) -> None:
    place = AACHEN["latitude"] + north, AACHEN["longitude"] + east
    x, y = heard(reader(FIX), fix(*place)) or (0.0, 0.0)
    right = METRES_OF_A_DEGREE * cos(radians(place[0])) * east
    assert hypot(x - right, y - METRES_OF_A_DEGREE * north) <= 1 + hypot(x, y) / 100
    tenths = [round(degrees * 1e7) for degrees in place]  # ETSI's units, to a centimetre
    assert heard(reader(CAM), cam(*tenths)) == pytest.approx((x, y), abs=0.02)
    named = reader("a_msgs/msg/A", latitude="lat", longitude="at.lon", scale=1e-7)
    other = Message(lat=tenths[0], at=Message(lon=tenths[1]))
    assert heard(named, other) == pytest.approx((x, y), abs=0.02)


def test_a_reference_system_has_its_own_origin() -> None:
    # the middle of UTM's zone 32 is 500 km to the west of its meridian's coordinate, by definition
    utm = reader(FIX, {"crs": "EPSG:25832", "x": 500_000.0, "y": 5_500_000.0, "datum": "EPSG:4258"})
    x, y = heard(utm, fix(50.0, 9.0)) or (1.0, 0.0)
    assert x == pytest.approx(0, abs=0.001)
    assert heard(utm, fix(50.1, 9.0)) == pytest.approx((0, y + METRES_OF_A_DEGREE / 10), abs=50)


def test_a_position_that_is_not_known_counts_as_silence() -> None:
    assert heard(reader(FIX), fix(0.0, 0.0, status=-1)) is None
    assert heard(reader(CAM), cam(900_000_001, 1_800_000_001)) is None
    assert heard(reader(CAM), cam(507_784_000, 1_800_000_001)) is None
    own = reader("a_msgs/msg/A", x="x", y="y", unavailable={"quality": 0})
    assert heard(own, Message(x=1, y=2, quality=0)) is None
    assert heard(own, Message(x=1, y=2, quality=1)) == (1, 2)


@pytest.mark.parametrize("place", [(91, 0), (0, -181), (90.1, 6.0)])
def test_a_place_that_the_map_has_not_is_left_out(place: tuple[float, float]) -> None:
    with pytest.raises(Unreadable, match="is not on the map"):
        heard(reader(FIX), fix(*place))
