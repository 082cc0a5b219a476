"""Each command prints at 80 columns what ``tests/terminal/expected`` has."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

import jsonschema_rs
import pytest
import yaml
from demandops.cli import main

from tests.kit.cli import Run
from tests.terminal.outputs import (
    CHANGING,
    COMMANDS,
    FOLDER,
    HELP,
    NOT_SHOWN,
    file_of,
    helps,
    make_fleet,
    printed,
)

SCHEMA = yaml.safe_load((Path(__file__).parents[2] / "docs" / "json.schema.yaml").read_text())


@pytest.fixture(scope="module")
def patch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[pytest.MonkeyPatch]:
    """Make the fleet once for all tests.

    Return the patch that sets the clock and the environment for the commands.
    """
    with pytest.MonkeyPatch.context() as made:
        folder = tmp_path_factory.mktemp("fleet")
        made.setenv("DEMANDOPS_DATA_HOME", str(folder / "home"))
        make_fleet(folder, made)
        yield made


@pytest.fixture(autouse=True)
def _home(data_home: Path, patch: pytest.MonkeyPatch) -> Iterator[None]:
    """Give each test the data folder of the fleet, which has the fleet's journals."""
    with pytest.MonkeyPatch.context() as made:
        made.setenv("DEMANDOPS_DATA_HOME", str(Path.cwd() / "home"))
        yield


@pytest.mark.parametrize("command", [*COMMANDS, *CHANGING])
def test_it_prints_what_it_printed(command: str, patch: pytest.MonkeyPatch) -> None:
    assert printed(command, patch) == file_of(command).read_text(), "make golden; review the diff"


def test_help_is_as_it_was_and_fits() -> None:
    assert helps() == HELP.read_text(), "make golden; review the diff"
    assert max(map(len, HELP.read_text().splitlines())) <= 80


def test_every_command_is_shown_or_says_why_not() -> None:
    every = (*COMMANDS, *CHANGING)
    shown = {command.split()[0] for command in every}
    assert shown | NOT_SHOWN.keys() == main.COMMANDS.keys()
    assert shown & NOT_SHOWN.keys() == set()
    assert {*FOLDER.iterdir()} == {HELP, *map(file_of, every)}


def schema_of(command: str) -> str:
    """Return the name of the schema of a command's JSON: the command, and its subcommand if any."""
    words = command.split()
    return "-".join(words[: 2 if words[0] in ("config", "override") else 1])


@pytest.mark.parametrize(
    "command", [*(one for one in COMMANDS if one != "schema"), "config list", "version"]
)
def test_its_json_is_as_the_schema_says(
    demandops: Run, command: str, patch: pytest.MonkeyPatch
) -> None:
    made = demandops(*shlex.split(command.replace("-o wide", "")), "-o", "json")
    schema = SCHEMA | {"$ref": f"#/$defs/{schema_of(command)}"}
    validator = jsonschema_rs.validator_for(schema)
    found = validator.iter_errors(made.json())
    assert [f"{error.instance_path}: {error.message}" for error in found] == []


def test_every_schema_is_that_of_a_command_or_of_a_thing_in_one() -> None:
    commands = {schema_of(command) for command in COMMANDS} | {"config-list", "version"}
    assert commands - {"schema"} <= SCHEMA["$defs"].keys()
