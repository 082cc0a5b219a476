"""A warning names each pattern of the policy that matches nothing."""

from __future__ import annotations

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


def test_each_pattern_that_matches_nothing_is_told_with_the_nearest_name() -> None:
    config = load(configuration({"policy/access-domains.yaml": POLICY}))
    file = "policy/access-domains.yaml: access domain 'perception', "
    told = [str(found) for found in warnings.unmatched_pattern_warnings(config)]
    nodes = ", ".join(sorted(config.nodes))
    assert told == [
        f"{file}nodes: 'roadside*' matches no node; known: {nodes}",
        f"{file}rule 'most': applications: 'object-detecton-fusion' matches no application "
        "definition; did you mean 'object-detection-fusion'?",
        f"{file}rule 'most': nodes: 'egde' matches no node of the domain; did you mean 'edge'?",
        f"{file}rule 'rest': peers: 'backend' matches no other access domain; there is none",
    ]


def test_the_configuration_as_it_is_has_none() -> None:
    assert list(warnings.unmatched_pattern_warnings(load(configuration({})))) == []
