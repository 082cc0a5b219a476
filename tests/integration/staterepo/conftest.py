"""Every test here uses git as Petra, and ends within its limit."""

import pytest


@pytest.fixture(autouse=True)
def _isolated(git_environment: None, limited: None) -> None:
    """Apply both to every test."""
