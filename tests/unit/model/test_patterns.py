"""Patterns of fields are said in words, and patterns of the policy that match nothing are told."""

from __future__ import annotations

from typing import Any

from demandops.base.naming import PATTERN_WORDS
from demandops.cli.repo.schema import SCHEMAS
from demandops.decide import warnings
from demandops.model.config.load import load

from tests.kit.config import configuration

POLICY = """
apiVersion: demandops/v1
kind: AccessDomains
domains:
  - name: perception
    namespace: perception
    nodes: ["*", roadside*]
    rules:
      - {name: most, applications: [object-detecton-fusion], nodes: [egde], brokers: ["edge"]}
      - {name: rest, requesters: [nobody-lists-them], peers: [backend]}
"""


def patterns_of(schema: Any) -> set[str]:
    if isinstance(schema, list):
        return {found for each in schema for found in patterns_of(each)}
    if not isinstance(schema, dict):
        return set()
    found = {schema["pattern"]} if isinstance(schema.get("pattern"), str) else set[str]()
    found |= {*schema.get("patternProperties", {})}
    return found | {each for value in schema.values() for each in patterns_of(value)}


def test_every_pattern_of_a_file_is_said_in_words() -> None:
    used = {one for model, _ in SCHEMAS.values() for one in patterns_of(model.model_json_schema())}
    assert used == PATTERN_WORDS.keys()


def unmatched(changed: dict[str, str]) -> list[str]:
    config = load(configuration({**changed}))
    return [str(found) for found in warnings.unmatched_pattern_warnings(config)]


def test_each_pattern_that_matches_nothing_is_told_with_the_nearest_name() -> None:
    file = "policy/access-domains.yaml: access domain 'perception', "
    assert unmatched({}) == []
    assert unmatched({"policy/access-domains.yaml": POLICY}) == [
        f"{file}nodes: 'roadside*' matches no node; known: "
        "cloud, edge, station00, vehicle00, vehicle01, vehicle02, vehicle03",
        f"{file}rule 'most': applications: 'object-detecton-fusion' matches no application "
        "definition; did you mean 'object-detection-fusion'?",
        f"{file}rule 'most': nodes: 'egde' matches no node of the domain; did you mean 'edge'?",
        f"{file}rule 'rest': peers: 'backend' matches no other access domain; there is none",
    ]
