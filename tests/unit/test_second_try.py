"""A test that fails in the gate runs once more: what fails again fails the gate."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CONFTEST = """
import os, pathlib
from tests.kit.second_try import SecondTry

def pytest_configure(config):
    if "UNSTEADY" in os.environ:
        config.pluginmanager.register(SecondTry(pathlib.Path(os.environ["UNSTEADY"])))
"""
TESTS = """
import os

def test_steady(): pass
def test_fails_at_first(): assert "UNSTEADY" not in os.environ
def test_fails(): assert os.environ.get("FAILS") is None
"""


@pytest.mark.nightly
@pytest.mark.parametrize("fails", [False, True])
def test_what_passes_alone_is_noted_as_unsteady(tmp_path: Path, fails: bool) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_it.py").write_text(TESTS)
    unsteady = tmp_path / "unsteady"
    environment = os.environ | {"UNSTEADY": str(unsteady), "PYTHONPATH": str(ROOT)}
    environment |= {"FAILS": "yes"} if fails else {}
    command = [sys.executable, "-m", "pytest", "-q", "-n0", f"--rootdir={tmp_path}"]
    ended = subprocess.run(command, cwd=tmp_path, env=environment, check=False)
    assert ended.returncode == fails
    noted = unsteady.read_text() if unsteady.exists() else ""
    assert noted == ("" if fails else "test_it.py::test_fails_at_first\n")
