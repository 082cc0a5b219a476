"""Puts the folder of tests on the path, for the model in ``tests/model``."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))


@pytest.fixture(autouse=True)
def _data_home(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here opens a state repo; should something do so, it stays in a temporary folder."""
    monkeypatch.setenv("DEMANDOPS_DATA_HOME", str(tmp_path_factory.getbasetemp() / "data"))
