"""Decisions to write down: goals decided one after another on the skeleton, all in memory."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path
from types import FrameType
from typing import Any

import pygit2
import pytest
from demandops.config.config import CONFIG_ROOTS
from demandops.config.load import load
from demandops.decision import Decision, State, decide
from demandops.ledger.ledger import Ledger
from demandops.staterepo import new_repo

NOW = datetime(2026, 3, 1, 12, 0, 7, tzinfo=timezone.utc)


@lru_cache(maxsize=1)
def _fresh() -> State:
    files = new_repo.files()
    config = load({path: files[path] for path in files if path.split("/")[0] in CONFIG_ROOTS})
    return State.of(config, Ledger())


class Desk:
    """Decides goals, each on top of the one before."""

    now = NOW

    def __init__(self) -> None:
        self.state = _fresh()
        self._files: dict[str, str | None] = {}

    def decide(self, goal: dict[str, Any]) -> Decision:
        decision = decide(self.state, goal, NOW, self._files.get)
        self.state = decision.state
        self._files |= decision.files
        return decision

    def join(
        self,
        *requesters: str,
        id: str = "intersection",
        application: str = "edge/fusion",
        cloud: str = "/stations/station00/pointcloud",
        shutdown: bool = False,
    ) -> Decision:
        """One application that takes in a point cloud of station00, and nothing that carries it."""
        topic = {"topic_name": cloud, "source_node_id": "station00"}
        body = {"requester_ids": list(requesters), "pointcloud_topics": [topic]}
        header = {"id": application, "node_id": "edge"}
        return self.decide(
            {
                "id": id,
                "shutdown": shutdown,
                "apps": [{"header": header, "type": 1, "object_detection_fusion_app": body}],
            }
        )

    def leave(self, *requesters: str, **options: Any) -> Decision:
        return self.join(*requesters, shutdown=True, **options)


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture
def repo(tmp_path: Path) -> pygit2.Repository:
    """An empty bare repository."""
    return pygit2.init_repository(str(tmp_path / "repo.git"), bare=True, initial_head="main")


@pytest.fixture(autouse=True)
def _limited() -> Iterator[None]:
    """Let no test take longer than half a minute."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TimeoutError("the test has not ended after 30 s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, 30)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(autouse=True)
def _own_data_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEMANDOPS_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", "/dev/null")
