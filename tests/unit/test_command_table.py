"""The table of commands: what `--help` lists, without the modules of the commands."""

from __future__ import annotations

import subprocess
import sys

import pytest
from demandops.cli import main

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


@pytest.mark.parametrize("name", main.COMMANDS)
def test_a_short_help_is_the_first_sentence_of_the_help(name: str) -> None:
    if name in ("demand", "serve"):
        pytest.importorskip("rclpy")
    command = main.load(name)
    _, short_help = main.COMMANDS[name]
    assert command.name == name
    assert command.get_short_help_str(limit=1000) == short_help


def test_short_helps_fit_a_terminal() -> None:
    assert all(len(short_help) <= 62 for _, short_help in main.COMMANDS.values())


def test_a_command_whose_package_is_missing_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delitem(sys.modules, "demandops_ros.serve_command", raising=False)
    assert main.run(["serve"]) == 1
    assert capsys.readouterr().err == (
        "error: serve needs rclpy, which is not installed; see README.md, 'With ROS 2'\n"
    )
