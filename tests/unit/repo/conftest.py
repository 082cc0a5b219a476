"""Fixtures: a state repo in memory, to which a test sends goals, and an empty Git repository."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import pygit2
import pytest
from demandops.decide.decision import Decision

from tests.kit import goals
from tests.kit.memory import MemoryRepo

NOW = datetime(2026, 3, 1, 12, 0, 7, tzinfo=timezone.utc)


class Desk(MemoryRepo):
    """A repo in memory, with a short method that sends a join for one application."""

    def join(
        self,
        *requesters: str,
        id: str = "intersection",
        application: str = "edge/fusion",
        cloud: str = "/stations/station00/pointcloud",
    ) -> Decision:
        app = goals.application(application, who=requesters, clouds=[(cloud, "station00")])
        return self.send(goals.goal([app], id=id))


@pytest.fixture
def desk() -> Desk:
    return Desk(now=NOW)


@pytest.fixture
def repo(tmp_path: Path) -> pygit2.Repository:
    return pygit2.init_repository(str(tmp_path / "repo.git"), bare=True, initial_head="main")


@pytest.fixture(autouse=True)
def _petra_commits(git_environment: None) -> None:
    """Make Petra the author of what a test commits with git."""
