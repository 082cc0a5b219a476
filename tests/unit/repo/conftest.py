"""A fixture: an empty Git repository."""

from __future__ import annotations

from pathlib import Path

import pygit2
import pytest


@pytest.fixture
def repo(tmp_path: Path) -> pygit2.Repository:
    return pygit2.init_repository(str(tmp_path / "repo.git"), bare=True, initial_head="main")
