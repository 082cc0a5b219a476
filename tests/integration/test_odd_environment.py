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

from tests.kit import rig
from tests.kit.limits import PATIENCE_S

LOST = r"error: the output cannot be written: "
BOOKED = "; done already: request 'demand-1' booked in {}"

# Each: a line for a shell, where $D is the program and $F a file with a demand, the exit code, and
# what the program says on stderr; {} is the newest commit afterwards.
ODD = {
    "closed": ("$D get nodes >&-", 1, f"{LOST}Bad file descriptor"),
    "full": ("$D get nodes >/dev/full", 1, f"{LOST}No space left on device"),
    "a reader that ends": ("$D log | true; exit ${PIPESTATUS[0]}", 0, ""),
    "closed, booked": ("$D request $F >&-", 1, f"{LOST}Bad file descriptor{BOOKED}"),
    "full, booked": (
        "$D request $F -o json >/dev/full",
        1,
        f"{LOST}No space left on device{BOOKED}",
    ),
    "a reader that ended, booked": (
        "{ sleep 0.1; exec $D request $F; } > >(exec >&-; true); exit",
        1,
        f"{LOST}Broken pipe{BOOKED}",
    ),
    "errors cannot be told": ("$D request $F >/dev/full 2>/dev/full", 1, ""),
    "nothing is open": ("$D request $F <&- >&- 2>&-", 1, ""),
    "Latin-1": ("PYTHONIOENCODING=latin-1 $D why →", 1, r"error: [^\n]*\\u2192[^\n]*"),
    "no UTF-8": (r"$D why $'\xff'", 1, r"error: the argument '\\udcff' is no text in utf-8; .*"),
    "no such locale": (
        "LC_ALL=C PYTHONCOERCECLOCALE=0 PYTHONUTF8=0 $D why ä",
        1,
        "error: the argument .* is no text in ascii; .* such as LANG=C.UTF-8",
    ),
    "relative home": (
        "env -u XDG_STATE_HOME DEMANDOPS_DATA_HOME= HOME=x $D request $F",
        1,
        "error: there is no home folder; set HOME or XDG_STATE_HOME to a folder",
    ),
    "no folder at home": (
        "env -u XDG_STATE_HOME DEMANDOPS_DATA_HOME= HOME=/dev/null $D request $F",
        1,
        "error: the data folder /dev/null/.* cannot be made: Not a directory; .*",
    ),
    "no current folder": (
        "mkdir gone; cd gone; rmdir ../gone; $D get nodes",
        1,
        "error: the current folder no longer exists; change to one that does",
    ),
}


@pytest.mark.parametrize("name", ODD)
def test_an_odd_environment_ends_a_command_with_one_line(
    bare: Path, data_home: Path, tmp_path: Path, name: str
) -> None:
    line, code, told = ODD[name]
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
