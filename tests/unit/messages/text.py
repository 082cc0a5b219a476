"""The text of ``messages.txt``: messages for the tests' example mistakes, and all JSON schemas."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from demandops.base.errors import Fault, Refused
from demandops.decide.state import State

from tests.kit.connections import routes
from tests.kit.forms import CONFIG_MODELS, GOAL_MODELS
from tests.kit.goals import perception
from tests.kit.memory import MemoryRepo
from tests.unit.connections import test_connection_types as of_connections
from tests.unit.decide import test_override_mistakes as of_overrides
from tests.unit.demand import test_refused as of_goals
from tests.unit.model import test_config_mistakes as of_config

FILE = Path(__file__).with_name("messages.txt")
_FOREIGN = re.compile(r"(not valid YAML: |input should be )(?!the key|a tag|another).*?(, not |$)")


def text() -> str:
    """Return the text that ``messages.txt`` must have."""
    standing = MemoryRepo().send(perception()).state
    sections = {
        "configuration": (
            (name, of_config.refused(changed)) for name, changed in of_config.MISTAKES.items()
        ),
        "overrides": (
            (name, of_overrides.refused(changed)) for name, changed in of_overrides.MISTAKES.items()
        ),
        "goals": ((name, _refusal(goal)) for name, goal in of_goals.REFUSED.items()),
        "goals that contradict the ledger": (
            (name, _refusal(goal, before=standing)) for name, goal in of_goals.CONTRADICTING.items()
        ),
        "connections": (
            (name, _refusal(routes(asked), before=before))
            for name, (before, asked) in of_connections.REFUSED.items()
        ),
        "the form of goals": ((name, _refusal(goal)) for name, goal in of_goals.WRONG.items()),
    }
    lines = ["Written by `make golden`. Words of pydantic and libyaml are replaced by …", ""]
    for title, cases in sections.items():
        lines += [f"# {title}", "", *_messages(cases), ""]
    return "\n".join([*lines, "# fields", "", *sorted(set(_fields())), ""])


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
    for model in (*CONFIG_MODELS.values(), *GOAL_MODELS):
        schema = model.model_json_schema()
        for part in (schema, *schema.get("$defs", {}).values()):
            if part.get("additionalProperties", True) is False:
                yield f"{part['title']}: no other fields"
            for name, field in part.get("properties", {}).items():
                form = {key: value for key, value in field.items() if key != "title"}
                needed = "required " if name in part.get("required", ()) else ""
                yield f"{part['title']}.{name}: {needed}{json.dumps(form, ensure_ascii=False)}"
