"""Commands that are run on the state repo `state`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.kit.cli import Ran, Run
from tests.kit.repo import GitRepo


@pytest.fixture
def on(demandops: Run, state: GitRepo) -> Run:
    """Return a function that runs a command with ``--state-repo``."""

    def call(*args: Any, stdin: str | bytes = "") -> Ran:
        return demandops(*args, "--state-repo", state.path, stdin=stdin)

    return call


@pytest.fixture
def ask(on: Run) -> Callable[..., Any]:
    """Return a function that runs a command, which must succeed, and returns its JSON."""

    def call(*args: str) -> Any:
        ran = on(*args, "--output", "json")
        assert (ran.code, ran.err) == (0, "")
        return ran.json()

    return call
