"""Nothing here opens a state repo; should something do so, it stays in a temporary folder."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _data_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEMANDOPS_DATA_HOME", str(tmp_path / "home"))
