"""Each mistake in a file of rules is reported with its line, its field and the remedy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.cli.repo import schema
from demandops.detect import rule_file

from tests.kit.detection import demand, rule, text_of

ROOT = Path(__file__).parents[3]
NEAR = {"source": "cars", "point": {"x": 0, "y": 0}, "start": 84, "stop": 90}
REQUEST: dict[str, Any] = {
    "id": "r",
    "connections": [{"requester_ids": ["{entity}"], "source_node_id": "{entity}"}],
}


def faults(text: str) -> list[str]:
    with pytest.raises(InvalidInput) as caught:
        rule_file.read(text, "rules.yaml")
    return [str(one) for one in caught.value.faults]


@pytest.mark.parametrize(
    ("mistake", "told"),
    [
        (
            rule("a", near={**NEAR, "stop": 84}),
            "rules.yaml:21: rules[0].near: 'stop' is 84, but must be more than 'start', which is "
            "84: between the two, the condition stays as it is, so that an entity near the limit "
            "does not start and stop it again and again",
        ),
        (
            rule("a", near={**NEAR, "source": "car"}),
            "rules.yaml:22: rules[0].near.source: 'car' is not in sources; did you mean 'cars'?",
        ),
        (
            rule("a", near={**NEAR, "source": "batteries"}),
            "rules.yaml:22: rules[0].near.source: source 'batteries' has no position; name the "
            "fields of its position in sources.batteries.x and y",
        ),
        (
            rule("a", near=NEAR, count=None, threshold={"source": "cars", "field": "x..y"}),
            "rules.yaml:31: rules[0].threshold.field: 'x..y' is not a field; write it like "
            "pose.position.x or ranges[0]",
        ),
        (
            rule("a", near=NEAR, count=None, threshold={"source": "cars", "field": f"x[{10**9}]"}),
            "rules.yaml:31: rules[0].threshold.field: 'x[1000000000]' is not a field; write it "
            "like pose.position.x or ranges[0]",
        ),
        (
            rule("a"),
            "rules.yaml:16: rules[0]: needs exactly one of near, together, count, threshold, "
            "schedule",
        ),
        (
            rule("a", near=NEAR, demand=demand(demand="{entiti}")),
            "rules.yaml:18: rules[0].demand.demand: '{entiti}' has no value here; did you mean "
            "'entity'?",
        ),
        (
            rule("a", near=NEAR, demand=demand(demand="{}")),
            "rules.yaml:18: rules[0].demand.demand: '{}' has no value here; known: distance, "
            "entity, rule, x, y",
        ),
        (
            rule("a", near=NEAR, demand=demand(request="{distance}")),
            "rules.yaml:21: rules[0].demand.request: '{distance}' becomes a number, but this field "
            "needs text; write a word before {distance}, such as 'near-{distance}'",
        ),
        (
            rule("a", near=NEAR, demand=demand(lease="{x}")),
            "rules.yaml:21: rules[0].demand.lease: must be a duration like 10m, or whole seconds, "
            "not 0.0",
        ),
        (
            rule("a", near={"source": "cars", "polygon": [{"x": 0, "y": 0}, {"x": 1, "y": 1}]}),
            "rules.yaml:23: rules[0].near.polygon: needs at least 3 entries, not 2",
        ),
        (
            rule("a", near=NEAR, demand=demand(demand="{entity", lease="1 day")),
            "rules.yaml:18: rules[0].demand.demand: has a single '{'; write '{{' for one brace",
        ),
        (
            rule("a", near=NEAR, demand=demand(lease="1 day")),
            "rules.yaml:21: rules[0].demand.lease: '1 day' is not a duration; write one like 90s, "
            "10m, 1h30m or 2d",
        ),
        (
            rule("a", near=NEAR, demand=demand(demand="{rule}")),
            "rules.yaml:18: rules[0].demand.demand: must name {entity}, because otherwise two "
            "events would share one demand",
        ),
        (
            rule("a", near=NEAR, demand=demand(demand="{entity}/{x}")),
            "rules.yaml:18: rules[0].demand.demand: '{x}' changes, but the demand's id "
            "must stay the same; leave that name out",
        ),
        (
            rule("a", near=NEAR, demand=demand(operation="release")),
            "rules.yaml:21: rules[0].demand.operation: is set by the detector; remove it",
        ),
        (
            rule("a", near=NEAR, deploymentRequest={**REQUEST, "shutdown": True}),
            "rules.yaml:30: rules[0].deploymentRequest.shutdown: is set by the detector; remove it",
        ),
        (
            rule(
                "a",
                near=NEAR,
                deploymentRequest={"id": "r", "connections": [{"requester_ids": ["s"]}]},
            ),
            "rules.yaml:27: rules[0].deploymentRequest.connections[0].requester_ids: must name "
            "{entity}, because a shutdown ends what its requesters hold, so each event needs its "
            "own requesters",
        ),
    ],
)
def test_a_mistake_is_told_with_its_line(mistake: dict[str, Any], told: str) -> None:
    assert told in faults(text_of(mistake))


def test_mistakes_of_sources_are_told_together() -> None:
    sources = {
        "a": {"topic": "/a/pose", "type": "geometry_msgs/msg/PoseStamped"},
        "b": {"topic": "b/{entity}", "type": "PoseStamped"},
        "c": {"topic": "/c/{entity}/{entity}", "type": "p/msg/M", "x": "x"},
        "d": {"topic": "/d/{entity}", "type": "p/msg/M", "timeout": "0s"},
    }
    assert faults(text_of(rule("r", near={**NEAR, "source": "a"}), sources=sources)) == [
        "rules.yaml:4: sources.a: must say at exactly one place where the name of the entity is: "
        "either write {entity} as a part of 'topic', or set 'entity' to the field of the message "
        "that has the name",
        "rules.yaml:8: sources.b.topic: 'b/{entity}' is not a topic name that ROS 2 allows; begin "
        "each part with a single '/', and write letters, digits and '_' after it, with no digit "
        "first",
        "rules.yaml:9: sources.b.type: 'PoseStamped' is not a message type; write it like "
        "std_msgs/msg/String",
        "rules.yaml:11: sources.c.topic: has {entity} twice; name the entity once",
        "rules.yaml:14: sources.d: timeout must be one second or more",
    ]


def test_two_rules_for_the_same_entities_have_demands_of_their_own() -> None:
    far = {**NEAR, "point": {"x": 500, "y": 0}}
    same, other = demand(demand="b/{entity}"), demand()
    told = faults(text_of(rule("a", near=NEAR, demand=same), rule("b", near=far, demand=other)))
    assert told == [
        "rules.yaml:30: rules[1].demand.demand: is also the id of a demand of rule 'a', so the "
        "event that ends first would end the other event's demand; add {rule} to one of the ids"
    ]
    cars = rule("a", near=NEAR, demand=same, entities=["car*"])
    rule_file.read(text_of(cars, rule("b", near=far, entities=["bus*"])), "rules.yaml")


def test_a_list_with_one_faulty_item_has_one_fault() -> None:
    hours = {"days": ["monday"], "start": "06:30", "stop": "07:30"}
    assert faults(text_of(rule("a", schedule=hours))) == [
        "rules.yaml:23: rules[0].schedule.days[0]: is 'monday', but must be 'mon', 'tue', 'wed', "
        "'thu', 'fri', 'sat' or 'sun'"
    ]


def test_a_zone_and_a_text_that_nobody_knows_are_mistakes() -> None:
    hours = {"start": "06:30", "stop": "24:00", "zone": "Europe/Berlim"}
    assert faults(text_of(rule("a", schedule=hours)))[-2:] == [
        "rules.yaml:23: rules[0].schedule.stop: '24:00' is not a time of day; write it like "
        '"07:30", in quotes',
        "rules.yaml:24: rules[0].schedule.zone: 'Europe/Berlim' is not a time zone; write it like "
        "Europe/Berlin",
    ]
    assert faults("\ud800") == [
        "rules.yaml: not valid YAML: it has a tag, number or character that cannot be read"
    ]


def test_the_mistakes_of_the_documentation_are_told_as_it_says() -> None:
    example = (ROOT / "examples" / "experiment" / "rules.yaml").read_text()
    told = faults(example.replace("stop: 90", "stop: 80", 1))
    told += faults(example.replace("{entity}/edge", "{entiti}/edge", 1))
    assert "\n".join(f"    {one}" for one in told) in (ROOT / "docs" / "detector.md").read_text()


def test_a_value_cannot_change_the_form_of_a_demand() -> None:
    named = demand(request='{entity}", "x": {{}}', positions=[{"node": "{entity}", "x": "{x}"}])
    file = rule_file.read(text_of(rule("a", near=NEAR, demand=named)), "rules.yaml")
    goal = file.rules[0].template.goal({"rule": "a", "entity": "{y}", "x": 1.5})
    assert goal.data == {
        "demand": "a/{y}",
        "requesters": ["{y}"],
        "request": '{y}", "x": {}',
        "positions": [{"node": "{y}", "x": 1.5}],
    }


def test_the_schema_takes_rules_and_nothing_misspelt() -> None:
    model, _ = schema.SCHEMAS["detector-rules"]
    validator = jsonschema_rs.validator_for(model.model_json_schema(by_alias=True))
    data = yaml.safe_load(text_of(rule("a", near=NEAR), rule("b", near=NEAR)))
    assert validator.is_valid(data)
    data["rules"][0]["nearly"] = {}
    assert not validator.is_valid(data)
