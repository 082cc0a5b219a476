"""Every test here uses git as Petra, and ends within its limit."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from demandops.service.approvals import check_timer

from tests.kit.clock import Clock
from tests.kit.git_over_http import Server, serving
from tests.kit.repo import Person


@pytest.fixture(autouse=True)
def _isolated(git_environment: None) -> None:
    """Commit as Petra in every test."""


@pytest.fixture
def clock() -> Clock:
    """The clock of the generators that are given it; it runs, and a test may set it forward."""
    return Clock()


@pytest.fixture
def server(bare: Path) -> Iterator[Server]:
    """A server of the state repo, with faults to order."""
    with serving(bare.parent) as running:
        yield running


@pytest.fixture
def http(server: Server) -> str:
    """The state repo behind that server."""
    return f"{server.url}/state.git"


@pytest.fixture
def petra(person: Person, monkeypatch: pytest.MonkeyPatch) -> Person:
    """A person who approves demands, at a generator that looks often."""
    monkeypatch.setattr(check_timer, "CHECK_EMBEDDED_S", 0.05)
    monkeypatch.setattr(check_timer, "CHECK_REMOTE_S", 0.1)
    person.policy(approval="required")
    return person
