"""What people write wrong in an override, and the message that names file, field and remedy."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from demandops.config.load import load
from demandops.errors import InvalidInput

from tests.kit.config import configuration

SOUND: dict[str, Any] = {
    "apiVersion": "demandops/v1",
    "kind": "Override",
    "reason": "a field test",
    "owner": "platform-team",
    "select": [{"services": ["object-detection"]}],
    "replicas": 2,
}
TAKES = "it must match ^[a-z0-9]([-a-z0-9]*[a-z0-9])?$"


EMPTY = object()


def text(**changed: Any) -> str:
    """Return a sound override with fields changed, left out (nothing) or left EMPTY."""
    fields = {name: value for name, value in (SOUND | changed).items() if value is not None}
    told = {name: None if value is EMPTY else value for name, value in fields.items()}
    return yaml.safe_dump(told, sort_keys=False)


def faults(**overrides: str) -> list[str]:
    files = {f"overrides/{name}.yaml": written for name, written in overrides.items()}
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(files))
    return [str(found) for found in invalid.value.faults]


MISTAKES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "no reason": ({"reason": None}, ["reason: is missing; add it"]),
    "no owner": ({"owner": None}, ["owner: is missing; add it"]),
    "nothing selected": ({"select": None}, ["select: is missing; add it"]),
    "a reason of two lines": (
        {"reason": "one\ntwo"},
        ["reason: 'one\\ntwo' is more than one line of plain text; write one line"],
    ),
    "an empty reason": (
        {"reason": " "},
        ["reason: is empty or starts or ends with white space; write one line of text"],
    ),
    "an owner with tricks": (
        {"owner": "a\u202eb"},
        ["owner: 'a\\u202eb' holds the control character U+202E; choose an id without it"],
    ),
    "an empty list": (
        {"select": []},
        ["select: is empty or has an empty item; name what to select"],
    ),
    "an empty selector": (
        {"select": [{}]},
        ["select[0]: selects nothing; give at least one field, for example nodes: ['*']"],
    ),
    "no pattern": (
        {"select": [{"nodes": []}]},
        ["select[0].nodes: is empty or has an empty item; name what to select"],
    ),
    "a pattern forgotten": (
        {"select": [{"nodes": None, "services": ["*"]}]},
        ["select[0]: nodes: has no value; fill it in, or remove it"],
    ),
    "an end forgotten": (
        {"expires": EMPTY},
        ["expires: has no value; fill it in, or remove it"],
    ),
    "a pattern that is no list": (
        {"select": [{"nodes": "edge"}]},
        ["select[0].nodes: must be a list, not 'edge'"],
    ),
    "a misspelt field": (
        {"select": [{"node": ["edge"]}]},
        ["select[0].node: is not a field here; remove it or correct its spelling"],
    ),
    "a misspelt effect": (
        {"replica": 2},
        [
            "replica: is not a field here; remove it or correct its spelling; did you mean "
            "'replicas'?"
        ],
    ),
    "a connection of an application": (
        {"select": [{"connections": ["*"], "services": ["*"]}]},
        ["select[0]: connections and services never match the same thing; write two selectors"],
    ),
    "no effect": (
        {"replicas": None},
        [
            "has no effect; give at least one of values, version, images, replicas, node, hold, "
            "deny, keep"
        ],
    ),
    "deny and more": (
        {"deny": True, "version": "0.1.0"},
        ["deny prevents it from running, so version and replicas cannot apply; remove one of them"],
    ),
    "hold and more": (
        {"hold": True, "values": {"a": 1}},
        ["hold freezes the release, so values and replicas cannot change it; remove one of them"],
    ),
    "hold that does not": ({"hold": False}, ["hold: is False, but must be True"]),
    "a connection moved": (
        {"select": [{"connections": ["*"]}], "replicas": None, "node": "cloud"},
        [
            "select[0].connections: node is for services, and connections have none; remove one "
            "of the two"
        ],
    ),
    "a service kept": (
        {"replicas": None, "keep": True},
        ["select[0].services: keep is for applications and connections; select those"],
    ),
    "no time": (
        {"expires": "tomorrow"},
        ["expires: 'tomorrow' is not a time with a time zone; write one like 2026-01-31T12:00:00Z"],
    ),
    "a time without zone": (
        {"expires": "2026-01-31T12:00:00"},
        [
            "expires: '2026-01-31T12:00:00' is not a time with a time zone; write one like "
            "2026-01-31T12:00:00Z"
        ],
    ),
    "a day that is none": (
        {"expires": "2026-02-31T12:00:00Z"},
        [
            "expires: '2026-02-31T12:00:00Z' is not a time with a time zone; write one like "
            "2026-01-31T12:00:00Z"
        ],
    ),
    "too many replicas": (
        {"replicas": 1001},
        ["replicas: input should be less than or equal to 1000, not 1001"],
    ),
    "a number that JSON lacks": (
        {"values": {"a": [{"b": float("inf")}]}},
        ["values: contains inf, which is not a number in JSON; choose another value"],
    ),
    "a pin that says nothing": (
        {"images": {"object-detection": {}}},
        ["images.object-detection: changes nothing; give a tag, a digest or a repository"],
    ),
    "an unknown image": (
        {"images": {"object-detektion": {"tag": "1"}}},
        [
            "images.object-detektion: 'object-detektion' is not in registry/images.yaml; did you "
            "mean 'object-detection'?"
        ],
    ),
    "an unknown node": (
        {"node": "edgy"},
        ["node: 'edgy' is not in nodes.yaml; did you mean 'edge'?"],
    ),
    "an unknown version": (
        {"version": "9.9.9"},
        [
            "version: '9.9.9' is not a version or channel in registry/charts.yaml of a selected "
            "chart; known: 0.1.0"
        ],
    ),
    "several at once": (
        {"owner": None, "priority": "high", "hold": False},
        [
            "owner: is missing; add it",
            "priority: must be a whole number, not 'high'",
            "hold: is False, but must be True",
        ],
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told_with_file_field_and_remedy(name: str) -> None:
    changed, expected = MISTAKES[name]
    assert faults(tested=text(**changed)) == [f"overrides/tested.yaml: {one}" for one in expected]


@pytest.mark.parametrize("path", ["overrides/a.yml", "overrides/A.yaml", "overrides/b/c.yaml"])
def test_a_file_that_is_no_override_is_told(path: str) -> None:
    with pytest.raises(InvalidInput) as invalid:
        load(configuration({path: text()}))
    assert [str(found) for found in invalid.value.faults] == [
        f"{path}: is not an override file; rename it to overrides/<name>.yaml, with lower-case "
        f"letters, digits and '-', or remove it"
    ]


def test_notes_are_passed_over_and_a_sound_override_is_taken() -> None:
    config = load(
        configuration(
            {"overrides/README.md": "hello", "overrides/.gitkeep": "", "overrides/a.yaml": text()}
        )
    )
    assert [one.path for one in config.active_overrides] == ["overrides/a.yaml"]


def test_a_node_in_no_access_domain_takes_nothing() -> None:
    domains = (
        "apiVersion: demandops/v1\nkind: AccessDomains\n"
        "domains: [{name: perception, namespace: perception, nodes: [edge]}]\n"
    )
    with pytest.raises(InvalidInput) as invalid:
        load(
            configuration(
                {"policy/access-domains.yaml": domains, "overrides/a.yaml": text(node="cloud")}
            )
        )
    assert [str(found) for found in invalid.value.faults] == [
        "overrides/a.yaml: node: 'cloud' is not in any access domain; add it to one in "
        "policy/access-domains.yaml"
    ]


def test_a_tie_names_both_files_and_the_remedy() -> None:
    other = text(select=[{"nodes": ["e*"]}], replicas=3)
    assert faults(one=text(), two=other) == [
        "overrides/two.yaml: priority: is 0, as in overrides/one.yaml, and both may set replicas "
        "of the same release; give one of them another priority, or select different releases"
    ]


@pytest.mark.parametrize(
    "other",
    [
        {"priority": 1},
        {"replicas": 2},
        {"replicas": None, "values": {"a": 1}},
        {"select": [{"services": ["object-fusion"]}]},
        {"replicas": None, "deny": True},
    ],
    ids=str,
)
def test_no_tie_where_it_does_not_matter_who_comes_last(other: dict[str, Any]) -> None:
    changed = {"replicas": 3} | other
    files = {"overrides/one.yaml": text(), "overrides/two.yaml": text(**changed)}
    assert len(load(configuration(files)).active_overrides) == 2
