"""``messages.txt`` has the messages for the tests' example mistakes, and all fields.

Its diff shows each change of them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import Fault, InvalidInput, Refused
from demandops.cli.authoring.schema import SCHEMAS
from demandops.decide.state import State

from tests.kit import plain_yaml
from tests.kit.connections import demand, routes
from tests.kit.connections import state as with_nodes
from tests.kit.goals import perception
from tests.kit.memory import MemoryRepo
from tests.scenarios.running import configuration
from tests.unit.demand import test_refused as of_goals
from tests.unit.model.test_config_mistakes import MISTAKES, refused

FILE = Path(__file__).with_name("messages.txt")
_FOREIGN = re.compile(r"(not valid YAML: |input should be )(?!the key|a tag|another).*?(, not |$)")
_CONNECTIONS, _OVERRIDES = (
    plain_yaml.load(FILE.with_name(f"{name}.yaml").read_text())
    for name in ("connections", "overrides")
)


def text() -> str:
    """Return the text that ``messages.txt`` must have."""
    standing = MemoryRepo().send(perception()).state
    overrides = {name: {"overrides/tested.yaml": one} for name, one in _OVERRIDES["fields"].items()}
    sections = {
        "configuration": ((name, refused(changed)) for name, changed in MISTAKES.items()),
        "overrides": (
            (name, refused(_with_overrides(changed)))
            for name, changed in (overrides | _OVERRIDES["files"]).items()
        ),
        "demands that an override breaks": (
            (name, _broken_by(fields)) for name, fields in _OVERRIDES["demand"].items()
        ),
        "goals": ((name, _refusal(goal)) for name, goal in of_goals.REFUSED.items()),
        "goals that contradict the ledger": (
            (name, _refusal(goal, before=standing)) for name, goal in of_goals.CONTRADICTING.items()
        ),
        "connections": (
            (name, _refused_connection(**case)) for name, case in _CONNECTIONS["cases"].items()
        ),
        "the form of goals": ((name, _refusal(goal)) for name, goal in of_goals.WRONG.items()),
    }
    lines = ["Written by `make golden`. Words of pydantic and libyaml are replaced by …", ""]
    for title, cases in sections.items():
        lines += [f"# {title}", "", *_messages(cases), ""]
    return "\n".join([*lines, "# fields", "", *sorted(set(_fields())), ""])


def _with_overrides(changed: dict[str, Any]) -> dict[str, str]:
    """Return a configuration with changed overrides, and with other files laid over it."""
    return configuration(
        config={
            path: _override(fields) if "over" in path else fields
            for path, fields in changed.items()
        }
    )


def _override(changed: dict[str, Any]) -> dict[str, Any]:
    fields = {
        name: value for name, value in (_OVERRIDES["valid"] | changed).items() if value is not None
    }
    return {name: None if value == "EMPTY" else value for name, value in fields.items()}


def _broken_by(fields: dict[str, Any]) -> tuple[Fault, ...]:
    repo = MemoryRepo(_with_overrides({"overrides/tested.yaml": {"replicas": None} | fields}))
    with pytest.raises(InvalidInput) as invalid:
        repo.send(perception())
    return invalid.value.faults


def _refused_connection(
    asks: dict[str, Any], nodes: str = "able", held: Iterable[dict[str, Any]] = (), **more: Any
) -> tuple[Fault, ...]:
    repo = MemoryRepo(state=with_nodes(**more, **_CONNECTIONS["nodes"][nodes]))
    for one in held:
        repo.send(routes(demand(**one)))
    return _refusal(routes(demand(**asks)), before=repo.state)


def _refusal(goal: object, *, before: State | None = None) -> tuple[Fault, ...]:
    taken = MemoryRepo(state=before).take(goal)
    assert isinstance(taken, Refused)
    return taken.faults


def _messages(cases: Iterable[tuple[str, Iterable[Fault]]]) -> Iterator[str]:
    for name, faults in cases:
        yield name
        for fault in faults:
            code = "" if fault.code == "invalid" else f" [{fault.code}]"
            yield f"    {_FOREIGN.sub(lambda match: f'{match[1]}…{match[2]}', str(fault))}{code}"


def _fields() -> Iterator[str]:
    """Yield each field of each file and goal with the field's JSON schema."""
    for model, _ in SCHEMAS.values():
        schema = model.model_json_schema()
        for part in (schema, *schema.get("$defs", {}).values()):
            if part.get("additionalProperties", True) is False:
                yield f"{part['title']}: no other fields"
            for name, field in part.get("properties", {}).items():
                form = {key: value for key, value in field.items() if key != "title"}
                needed = "required " if name in part.get("required", ()) else ""
                yield f"{part['title']}.{name}: {needed}{json.dumps(form, ensure_ascii=False)}"


def test_messages_are_those_of_the_file() -> None:
    assert text() == FILE.read_text(), "run `make golden` and review the diff"
