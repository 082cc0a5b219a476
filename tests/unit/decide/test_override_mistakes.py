"""Mistakes that people make in overrides; ``tests/unit/messages`` has the messages."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from demandops.base.errors import Fault, InvalidInput
from demandops.model.config.load import load
from demandops.model.ledger.ledger import Ledger, World

from tests.kit.config import configuration, edited

VALID: dict[str, Any] = {
    "apiVersion": "demandops/v1",
    "kind": "Override",
    "reason": "a field test",
    "owner": "platform-team",
    "select": [{"services": ["object-detection"]}],
    "replicas": 2,
}
EMPTY = object()


def text(**changed: Any) -> str:
    """Return a valid override with fields changed, left out (``None``) or empty (``EMPTY``)."""
    fields = {name: value for name, value in (VALID | changed).items() if value is not None}
    told = {name: None if value is EMPTY else value for name, value in fields.items()}
    return yaml.safe_dump(told, sort_keys=False)


def refused(changed: dict[str, str]) -> tuple[Fault, ...]:
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(changed))
    return invalid.value.faults


_FIELDS: dict[str, dict[str, Any]] = {
    "a reason of two lines": {"reason": "one\ntwo"},
    "an empty reason": {"reason": " "},
    "an empty list": {"select": []},
    "an empty selector": {"select": [{}]},
    "no pattern": {"select": [{"nodes": []}]},
    "a pattern forgotten": {"select": [{"nodes": None, "services": ["*"]}]},
    "an end forgotten": {"expires": EMPTY},
    "a misspelt effect": {"replica": 2},
    "a connection of an application": {"select": [{"connections": ["*"], "services": ["*"]}]},
    "no effect": {"replicas": None},
    "deny and more": {"deny": True, "version": "0.1.0"},
    "hold and more": {"hold": True, "values": {"a": 1}},
    "a connection moved": {"select": [{"connections": ["*"]}], "replicas": None, "node": "cloud"},
    "a service moved for some": {
        "select": [{"services": ["object-fusion"], "requesters": ["v"]}],
        "replicas": None,
        "node": "cloud",
    },
    "a service kept": {"replicas": None, "keep": True},
    "no time": {"expires": "tomorrow"},
    "a time without zone": {"expires": "2026-01-31T12:00:00"},
    "a day that is none": {"expires": "2026-02-31T12:00:00Z"},
    "a number that JSON lacks": {"values": {"a": [{"b": float("inf")}]}},
    "a pin that says nothing": {"images": {"object-detection": {}}},
    "an unknown image": {"images": {"object-detektion": {"tag": "1"}}},
    "an unknown node": {"node": "edgy"},
    "an unknown version": {"version": "9.9.9"},
    "several at once": {"owner": None, "priority": "high", "hold": False},
}


APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
DOMAINS = """\
apiVersion: demandops/v1
kind: AccessDomains
domains: [{name: perception, namespace: perception, nodes: [edge]}]
"""
MISTAKES: dict[str, dict[str, str]] = {
    **{name: {"overrides/tested.yaml": text(**changed)} for name, changed in _FIELDS.items()},
    **{
        f"no override file: {path}": {path: text()}
        for path in ("overrides/a.yml", "overrides/A.yaml", "overrides/b/c.yaml")
    },
    "a node in no access domain": {
        "policy/access-domains.yaml": DOMAINS,
        "overrides/a.yaml": text(node="cloud"),
    },
    "a service at its source moved": {
        **edited(APPDEF, "prefix: od\n", "prefix: od\n    placement: source\n"),
        "overrides/a.yaml": text(node="cloud"),
    },
    "a tie": {
        "overrides/one.yaml": text(),
        "overrides/two.yaml": text(select=[{"nodes": ["e*"]}], replicas=3),
    },
}


def test_notes_are_passed_over_and_a_sound_override_is_taken() -> None:
    config = load(
        configuration(
            {"overrides/README.md": "hello", "overrides/.gitkeep": "", "overrides/a.yaml": text()}
        )
    )
    assert [one.path for one in World(config, Ledger()).overrides] == ["overrides/a.yaml"]


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
    assert len(World(load(configuration(files)), Ledger()).overrides) == 2
