"""Every test here uses git as Petra, and ends within its limit."""

import pytest

from tests.kit.clock import Clock


@pytest.fixture(autouse=True)
def _isolated(git_environment: None, limited: None) -> None:
    """Apply both to every test."""


@pytest.fixture
def clock() -> Clock:
    """The clock of the generators that are given it; it runs, and a test may set it forward."""
    return Clock()
