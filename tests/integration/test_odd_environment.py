"""Outputs, folders, encodings and limits that a command cannot use end it with one line."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.kit import plain_yaml, rig
from tests.kit.limits import PATIENCE_S

ODD = plain_yaml.beside(__file__)


@pytest.mark.parametrize("name", ODD)
def test_an_odd_environment_ends_a_command_with_one_line(
    bare: Path, data_home: Path, tmp_path: Path, name: str
) -> None:
    line, code, told = ODD[name].values()
    file = tmp_path / "demand.yaml"
    file.write_text(yaml.safe_dump(rig.goal(1)))
    program = f"{sys.executable} -P -m demandops.cli.main"
    environment = os.environ | {
        "D": program,
        "F": str(file),
        "DEMANDOPS_STATE_REPO": str(bare),
        "LC_ALL": "C.UTF-8",
    }
    ran = subprocess.run(
        ["bash", "-c", line],
        cwd=tmp_path,
        env=environment,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        timeout=PATIENCE_S,
        check=False,
    )
    said = ran.stderr.decode("utf-8", "backslashreplace")
    expected = told.replace("{}", rig.tip(bare)) + "\n" if told else ""
    assert re.fullmatch(expected, said), said
    assert ran.returncode == code
    if "$F" in line and "data folder" not in told and "home" not in told:
        assert len(rig.operations(bare)) == 1


def test_json_is_whole_in_any_encoding(bare: Path, tmp_path: Path) -> None:
    file = tmp_path / "demand.yaml"
    file.write_text(yaml.safe_dump(rig.goal(1) | {"id": "ä→🚗"}))
    command = [sys.executable, "-P", "-m", "demandops.cli.main", "request", str(file)]
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "DEMANDOPS_STATE_REPO": str(bare)}
    printed = subprocess.check_output([*command, "-o", "json"], env=environment)
    assert json.loads(printed.decode("ascii"))[0]["request"] == "ä→🚗"
