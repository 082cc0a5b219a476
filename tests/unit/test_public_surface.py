"""The public surface is `public_surface.yaml`; a change of that file is a change for users.

The fields of files and goals are in ``messages/messages.txt``.

Everything else is internal. `docs/public-api.md` is the same list for people.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import demandops
import demandops_ros
import jsonschema_rs
import pytest
import yaml
from demandops.base import settings
from demandops.base.naming import PATTERN_WORDS
from demandops.cli import main
from demandops.cli.authoring import schema
from demandops.cli.authoring.schema import SCHEMAS

from tests.golden.cases import CASES, rendered

ROOT = Path(__file__).parents[2]
INTERFACES = ROOT / "ros_bridge" / "interfaces"
PAGE = (ROOT / "docs" / "public-api.md").read_text()
PUBLIC = yaml.safe_load(Path(__file__).with_name("public_surface.yaml").read_text())

Json = dict[str, Any]


def command_of(command: click.Command) -> Json | list[str]:
    if isinstance(command, click.Group):
        return {name: command_of(each) for name, each in sorted(command.commands.items())}
    return [parameter(each) for each in command.params]


def parameter(each: click.Parameter) -> str:
    if isinstance(each, click.Argument):
        return str(each.metavar)
    assert isinstance(each, click.Option)
    choices = each.type.choices if isinstance(each.type, click.Choice) else ()
    value = "|".join(choices) or each.metavar or each.type.name.upper()
    text = " ".join(each.opts if each.is_flag else [*each.opts, value])
    return f"{text} [env: {each.envvar}]" if each.envvar else text


def members(exported: Any) -> Json | str:
    """Return a map from each public member of a class to its arguments, or to ``field``.

    The constructor is in the map if it has a docstring.
    """
    if not inspect.isclass(exported):
        return "type"
    names = ["__init__"] if getattr(vars(exported).get("__init__"), "__doc__", None) else []
    names += [name for name in vars(exported) if not name.startswith("_")]
    return {name: arguments(getattr(exported, name)) for name in names}


def arguments(member: Any) -> str:
    if not inspect.isfunction(member):
        return "field"
    _, *given = inspect.signature(member).parameters.values()
    bare = []
    for each in given:
        default = ... if inspect.isfunction(each.default) else each.default
        bare.append(each.replace(annotation=inspect.Parameter.empty, default=default))
    return str(inspect.Signature(bare))


def interfaces() -> Json:
    """Return the fields of each action, message and service."""
    found = {}
    packages = [path.parent for path in INTERFACES.glob("*/package.xml")]
    for path in sorted(path for package in packages for path in package.rglob("*.*")):
        if path.suffix in (".action", ".msg", ".srv"):
            lines = (line.partition("#")[0].split() for line in path.read_text().splitlines())
            name = f"{path.relative_to(INTERFACES).parts[0]}/{path.stem}"
            found[name] = [" ".join(words) for words in lines if words]
    return found


def claim_files() -> Json:
    """Return the fields of the claims in the golden cases, by version and kind."""
    found: dict[str, set[str]] = {}
    steps = (files for case in CASES for files in rendered(case).values())
    texts = {text for files in steps for path, text in files.items() if path.startswith("ledger/")}
    for claim in map(yaml.safe_load, texts):
        names = found.setdefault(f"{claim['apiVersion']} {claim['kind']}", set())
        names.update(claim)
        for held in ("application", "connection"):
            names.update(f"{held}.{name}" for name in claim.get(held, ()))
    return {kind: " ".join(sorted(names)) for kind, names in sorted(found.items())}


def environment() -> list[str]:
    sources = (ROOT / "generator").rglob("*.py"), (ROOT / "ros_bridge/demandops_ros").rglob("*.py")
    texts = [path.read_text() for paths in sources for path in paths]
    return sorted({name for text in texts for name in re.findall(r"\bDEMANDOPS_[A-Z_]+\b", text)})


SECTIONS: dict[str, Callable[[], object]] = {
    "options": lambda: [parameter(each) for each in main.cli.params],
    "commands": lambda: {name: command_of(main.load(name)) for name in main.COMMANDS},
    "exit codes": lambda: {each.name: each.value for each in main.ExitCode},
    "environment": environment,
    "client": lambda: {
        name: members(getattr(demandops_ros, name)) for name in demandops_ros.__all__
    },
    "ROS interfaces": interfaces,
    "claim files": claim_files,
}


@pytest.mark.parametrize("section", SECTIONS)
def test_the_public_surface_is_the_listed_one(section: str) -> None:
    if section in ("commands", "client"):
        pytest.importorskip("rclpy")
    assert SECTIONS[section]() == PUBLIC[section]


def test_every_section_is_listed() -> None:
    assert list(PUBLIC) == list(SECTIONS)


def test_the_package_exports_its_version_alone() -> None:
    names = {name for name, value in vars(demandops).items() if not isinstance(value, ModuleType)}
    assert {name for name in names if not name.startswith("_")} == set()
    assert demandops.__all__ == ["__version__"]


def test_people_find_everything_in_the_documentation() -> None:
    listed = {word for text in re.findall(r"`([^`]+)`", PAGE) for word in text.split()}
    interface_names = {name.split("/")[1] for name in PUBLIC["ROS interfaces"]}
    kinds = {text for kind in PUBLIC["claim files"] for text in kind.split()}
    names = {*PUBLIC["environment"], *PUBLIC["client"], *SCHEMAS}
    names |= {*map(str, PUBLIC["exit codes"].values()), *interface_names, *kinds}
    assert {*names, settings.API_VERSION} - listed == set()


# ---- the published schemas ----


def properties(name: str) -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Yield each property of a published schema: its name, its schema, and the whole document."""
    document = json.loads(schema.text(name))
    root = SCHEMAS[name][0].__name__
    for model, part in {root: document, **document.get("$defs", {})}.items():
        for field, one in part.get("properties", {}).items():
            yield f"{model}.{field}", one, document


@pytest.mark.parametrize("name", SCHEMAS)
def test_every_property_has_a_description_and_a_valid_example(name: str) -> None:
    bare = [
        field
        for field, one, _ in properties(name)
        if not one.get("description") or not one.get("examples")
    ]
    assert bare == [], "add them to templates/schemas/properties.yaml"
    for field, one, document in properties(name):
        own = {"$schema": document["$schema"], "$defs": document.get("$defs", {}), **one}
        validator = jsonschema_rs.validator_for(own)
        for example in one["examples"]:
            faults = [error.message for error in validator.iter_errors(example)]
            assert faults == [], (field, example)


def test_nothing_else_is_described_and_each_entry_has_at_most_an_example() -> None:
    known = {field for name in SCHEMAS for field, *_ in properties(name)}
    listed = {
        f"{model.rpartition('/')[2]}.{field}": said
        for model, fields in schema._properties().items()
        if model != "inherits"
        for field, said in fields.items()
    }
    assert listed.keys() - known == set()
    odd = [field for field, said in listed.items() if len(said) > 2 or not isinstance(said[0], str)]
    assert odd == []


def patterns_of(part: Any) -> set[str]:
    if isinstance(part, list):
        return {found for each in part for found in patterns_of(each)}
    if not isinstance(part, dict):
        return set()
    found = {part["pattern"]} if isinstance(part.get("pattern"), str) else set[str]()
    found |= {*part.get("patternProperties", {})}
    return found | {each for value in part.values() for each in patterns_of(value)}


def test_every_pattern_of_a_file_is_said_in_words() -> None:
    used = {one for model, _ in SCHEMAS.values() for one in patterns_of(model.model_json_schema())}
    assert used == PATTERN_WORDS.keys()


if __name__ == "__main__":  # writes the listing; review the diff
    listing = {name: section() for name, section in SECTIONS.items()}
    text = yaml.safe_dump(listing, sort_keys=False, width=100, allow_unicode=True)
    Path(__file__).with_name("public_surface.yaml").write_text(text)
