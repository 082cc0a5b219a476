"""The mistakes in a file of rules, and what a rule's demand is made from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
import yaml
from demandops.base.errors import Fault, InvalidInput
from demandops.cli.authoring import schema
from demandops.detect import rule_file

from tests.kit import plain_yaml
from tests.kit.detection import demand, rule, text_of

ROOT = Path(__file__).parents[3]
NEAR = {"source": "cars", "point": {"x": 0, "y": 0}, "start": 84, "stop": 90}
MISTAKES = plain_yaml.beside(__file__, "mistakes")


def faults(text: str) -> tuple[Fault, ...]:
    with pytest.raises(InvalidInput) as caught:
        rule_file.read(text, "rules.yaml")
    return caught.value.faults


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda one: f"{one['field']}: {one['says']}")
def test_a_mistake_is_told_with_its_line(mistake: dict[str, Any]) -> None:
    fields = {**mistake.get("rule", {})}
    if fields.get("near", {}) is not None:
        fields["near"] = NEAR | fields.get("near", {})
    if "polygon" in (fields["near"] or ()):
        del fields["near"]["point"]
    if "demand" in mistake:
        fields["demand"] = demand(**mistake["demand"])
    file = {name: mistake[name] for name in ("sources", "map") if name in mistake}
    told = faults(text_of(rule("a", **fields), **file))
    field = f"{'' if file else 'rules[0].'}{mistake['field']}".removesuffix(".")
    here = [one for one in told if (one.line, one.field) == (mistake["line"], field)]
    assert any(mistake["says"] in one.message for one in here), told


def test_a_list_with_one_faulty_item_has_one_fault() -> None:
    hours = {"days": ["monday"], "start": "06:30", "stop": "07:30"}
    assert len(faults(text_of(rule("a", schedule=hours)))) == 1


def test_two_rules_for_the_same_entities_have_demands_of_their_own() -> None:
    far = {**NEAR, "point": {"x": 500, "y": 0}}
    same, other = demand(demand="b/{entity}"), demand()
    (told,) = faults(text_of(rule("a", near=NEAR, demand=same), rule("b", near=far, demand=other)))
    assert (told.line, told.field) == (30, "rules[1].demand.demand")
    assert "is also the id of a demand of rule 'a'" in told.message
    join = {"id": "r", "connections": [{"requester_ids": ["{entity}"], "source_node_id": "a"}]}
    twice = (rule(name, near=NEAR, deploymentRequest=join) for name in "ab")
    assert [each.field for each in faults(text_of(*twice))] == ["rules[1].deploymentRequest.id"]
    cars = rule("a", near=NEAR, demand=same, entities=["car*"])
    rule_file.read(text_of(cars, rule("b", near=far, entities=["bus*"])), "rules.yaml")


def test_a_text_that_is_no_yaml_is_a_mistake() -> None:
    assert "not valid YAML" in faults("\ud800")[0].message


def test_the_mistakes_of_the_documentation_are_told_as_it_says() -> None:
    example = (ROOT / "examples" / "experiment" / "rules.yaml").read_text()
    told = faults(example.replace("stop: 90", "stop: 80", 1))
    told += faults(example.replace("{entity}/edge", "{entiti}/edge", 1))
    assert "\n".join(f"    {one}" for one in told) in (ROOT / "docs" / "detector.md").read_text()


def test_a_value_cannot_change_the_form_of_a_demand() -> None:
    named = demand(
        request='{entity}", "x": {}, ${entity}', positions=[{"node": "{entity}", "x": "{x}"}]
    )
    file = rule_file.read(text_of(rule("a", near=NEAR, demand=named)), "rules.yaml")
    goal = file.rules[0].template.filled({"rule": "a", "entity": "{y}", "x": 1.5})
    assert goal.data == {
        "demand": "a/{y}",
        "requesters": ["{y}"],
        "request": '{y}", "x": {}, ${entity}',
        "positions": [{"node": "{y}", "x": 1.5}],
    }


def test_the_schema_takes_rules_and_nothing_misspelt() -> None:
    model, _ = schema.SCHEMAS["detector-rules"]
    validator = jsonschema_rs.validator_for(model.model_json_schema(by_alias=True))
    data = yaml.safe_load(text_of(rule("a", near=NEAR), rule("b", near=NEAR)))
    assert validator.is_valid(data)
    data["rules"][0]["nearly"] = {}
    assert not validator.is_valid(data)
