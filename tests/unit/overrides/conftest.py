"""Puts the builders of goals, ``tests/unit/demand/asking.py``, on the path."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "demand"))


@pytest.fixture(autouse=True)
def _data_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEMANDOPS_DATA_HOME", str(tmp_path / "home"))
