"""`--help` lists the commands from a table, without an import of the commands' modules."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from inspect import cleandoc
from pathlib import Path
from typing import get_args

import click
import demandops
import pytest
from demandops.cli import main
from demandops.cli.queries.commits import OPERATIONS
from demandops.model.demand.demand import Operation

PRINT_THIRD_PARTY = """
import sys
before = {name.partition(".")[0] for name in sys.modules}
from demandops.cli.main import run
assert run(sys.argv[1:]) == 0
names = {name.partition(".")[0] for name in sys.modules} - before - sys.stdlib_module_names
print("loaded:", *sorted(names), *({"importlib.metadata"} & set(sys.modules)))
"""


@pytest.mark.parametrize("option", ["--version", "--help"])
def test_help_and_version_import_click_alone(option: str) -> None:
    command = [sys.executable, "-c", PRINT_THIRD_PARTY, option]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    *shown, loaded = ran.stdout.splitlines()
    assert loaded == "loaded: click demandops"
    assert option == "--version" or all(name in "\n".join(shown) for name in main.COMMANDS)


def skip_without_ros(name: str) -> None:
    module = next(module for module, names in main.MODULES.items() if name in names.split())
    if module.startswith("demandops_ros"):
        pytest.importorskip("rclpy")


@pytest.mark.parametrize("name", main.COMMANDS)
def test_a_short_help_is_a_sentence_that_fits_a_terminal(name: str) -> None:
    skip_without_ros(name)
    command = main.load(name)
    assert command.name == name
    assert command.get_short_help_str(limit=1000) == main.COMMANDS[name]
    assert len(main.COMMANDS[name]) <= 62


def commands_of(command: click.Command, *names: str) -> Iterator[tuple[str, click.Command]]:
    yield " ".join(names), command
    if isinstance(command, click.Group):
        for name, each in command.commands.items():
            yield from commands_of(each, *names, name)


def examples_of(command: click.Command) -> list[list[str]]:
    """Return the words of each command line in the examples, without pipes and redirections."""
    _, _, block = cleandoc(command.help or "").partition("\nExamples:\n")
    lines = re.sub(r"\\\n", " ", block).splitlines()
    return [shlex.split(re.split(r" [|>] ", line)[0]) for line in lines]


@pytest.mark.parametrize("name", main.COMMANDS)
def test_every_command_has_examples_that_parse(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    skip_without_ros(name)
    monkeypatch.setenv("DEMANDOPS_STATE_REPO", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for path, command in commands_of(main.load(name), name):
        examples = examples_of(command)
        assert examples, f"{path} has no examples"
        for program, *words in examples:
            assert program == "demandops"
            parse(main.cli, words)


def parse(command: click.Command, words: list[str], parent: click.Context | None = None) -> None:
    """Parse a command line as the program does, including subcommands, but run nothing."""
    ctx = command.make_context("demandops", words, parent=parent)
    if isinstance(command, click.Group):
        _, found, rest = command.resolve_command(ctx, [*ctx._protected_args, *ctx.args])
        assert found is not None, words
        parse(found, rest, ctx)


@pytest.mark.parametrize(
    ("command", "missing", "loaded", "remedy"),
    [
        (["serve"], "rclpy", ("demandops_ros.", "rclpy."), "see README.md, 'With ROS 2'"),
        (["diff", "a", "b"], "difflib",
         ("demandops.cli.queries.commits", "demandops.decide.state"),
         "install demandops again"),
    ],
)  # fmt: skip
def test_a_command_whose_package_is_missing_says_so(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: list[str],
    missing: str,
    loaded: tuple[str, ...],
    remedy: str,
) -> None:
    for name in [each for each in sys.modules if each.startswith(loaded)]:
        if name.startswith("rclpy."):
            monkeypatch.setitem(sys.modules, name, None)
        else:
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    assert main.run(command) == 1
    told = f"error: {command[0]} needs {missing}, which is not installed; {remedy}\n"
    assert capsys.readouterr().err == told


def test_a_path_that_cannot_be_written_is_no_fault_of_the_program(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert main.run(["schema", "--write", str(tmp_path / "file" / "folder")]) == 1
    assert capsys.readouterr().err.startswith(f"error: {tmp_path}/file/folder: Not a directory; ")


WRITTEN = re.compile(r'\("Operation", "([a-z-]+)"\)')


def test_every_operation_can_be_asked_for() -> None:
    texts = (path.read_text() for path in Path(demandops.__file__).parent.rglob("*.py"))
    written = {name for text in texts for name in WRITTEN.findall(text)}
    assert written | {*get_args(Operation), "by-hand"} == {*OPERATIONS}
