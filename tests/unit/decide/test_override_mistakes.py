"""Mistakes that people make in overrides; ``tests/unit/messages`` has the messages."""

from __future__ import annotations

from typing import Any

import pytest
from demandops.base.errors import Fault, InvalidInput
from demandops.model.config.load import load
from demandops.model.ledger.ledger import Ledger, World

from tests.kit import plain_yaml
from tests.scenarios.running import configuration

_READ = plain_yaml.beside(__file__)
Files = dict[str, dict[str, Any]]


def override(**changed: Any) -> dict[str, Any]:
    fields = {
        name: value for name, value in (_READ["valid"] | changed).items() if value is not None
    }
    return {name: None if value == "EMPTY" else value for name, value in fields.items()}


def files(changed: Files) -> dict[str, str]:
    """Return a configuration with changed overrides, and with other files laid over it."""
    overrides = {path: override(**fields) for path, fields in changed.items() if "over" in path}
    return configuration(config=changed | overrides)


def refused(changed: Files) -> tuple[Fault, ...]:
    with pytest.raises(InvalidInput) as invalid:
        load(files(changed))
    return invalid.value.faults


MISTAKES: dict[str, Files] = {
    **{name: {"overrides/tested.yaml": changed} for name, changed in _READ["fields"].items()},
    **_READ["files"],
}


def test_notes_are_passed_over_and_a_sound_override_is_taken() -> None:
    notes = {"overrides/README.md": "hello", "overrides/.gitkeep": ""}
    config = load(files({"overrides/a.yaml": {}}) | notes)
    assert [one.path for one in World(config, Ledger()).overrides] == ["overrides/a.yaml"]
