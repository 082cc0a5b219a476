"""Messages become observations: positions and fields by path, entities by topic or field."""

from __future__ import annotations

from types import SimpleNamespace as Message
from typing import Any

import pytest
from demandops.detect import rule_file
from demandops.detect.condition import entity_in
from demandops.detect.observations import MessageReader, Unreadable
from demandops.detect.rule_file import POSITIONS

from tests.kit.detection import rule, text_of

HOT = {"source": "all", "field": "engine.heat[1]", "above": 90, "stop": 80}


def reader(type_name: str = "a_msgs/msg/A", **fields: Any) -> MessageReader:
    source = {"topic": "/all/{entity}", "type": type_name} | fields
    text = text_of(rule("hot", threshold=HOT), sources={"all": source})
    return MessageReader(rule_file.read(text, "rules.yaml"), "all")


def message(x: object = 1, **more: Any) -> Message:
    """Return a message that has the position fields of all known types."""
    point = Message(position=Message(x=x, y=2))
    pose = Message(position=Message(x=x, y=2), pose=point)
    state = Message(continuous_state=[x, 2])
    return Message(pose=pose, state=state, engine=Message(heat=[20, 95]), **more)


@pytest.mark.parametrize("type_name", POSITIONS)
def test_the_position_of_known_types_is_found(type_name: str) -> None:
    seen = reader(type_name).observation(message(), "car", 7)
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
        reader("geometry_msgs/msg/PoseStamped").observation(sent, "car", 7)
    assert str(caught.value).startswith(why)


@pytest.mark.parametrize(
    ("pattern", "topic", "entity"),
    [
        ("/cars/{entity}/pose", "/cars/car7/pose", "car7"),
        ("/cars/{entity}/pose", "/cars/a/b/pose", None),
        ("/car_{entity}", "/car_7", "7"),
        ("/cars/{entity}/pose", "/cars/car7/pose2", None),
        ("/poses", "/poses", ""),
        ("/poses", "/poses2", None),
    ],
)
def test_an_entity_is_one_part_of_a_topic(pattern: str, topic: str, entity: str | None) -> None:
    assert entity_in(pattern, topic) == entity
