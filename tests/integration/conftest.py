"""Commands that are run on the state repo `state`."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from tests.kit.cli import Ran, Run
from tests.kit.repo import GitRepo


class On:
    def __init__(self, demandops: Run, state: GitRepo) -> None:
        self._run, self.state = demandops, state

    def __call__(self, *args: Any, stdin: str | bytes = "") -> Ran:
        return self._run(*args, "--state-repo", self.state.path, stdin=stdin)

    def json(self, *args: Any, stdin: str | bytes = "") -> Any:
        """Run a command, which must succeed and warn of nothing; return what it prints."""
        ran = self(*args, "--output", "json", stdin=stdin)
        assert (ran.code, ran.err) == (0, "")
        return ran.json()

    def refused(self, *args: Any, code: int = 1, stdin: str | bytes = "") -> str:
        """Run a command, which must change and print nothing; return its errors."""
        before = self.state.tip
        ran = self(*args, stdin=stdin)
        assert (ran.code, ran.out, self.state.tip) == (code, "", before), ran.err
        return ran.err

    def request(self, *goals: object, more: tuple[Any, ...] = ()) -> Ran:
        text = yaml.safe_dump_all(goals, sort_keys=False, allow_unicode=True)
        return self("request", "-", "--output", "json", *more, stdin=text)

    def book(self, *goals: object, more: tuple[Any, ...] = ()) -> Ran:
        """Send goals, of which none may be refused; return what ``demandops request`` says."""
        ran = self("request", "-", *more, stdin=yaml.safe_dump_all(goals, sort_keys=False))
        assert ran.code == 0, ran.err
        return ran


@pytest.fixture
def on(demandops: Run, state: GitRepo) -> On:
    return On(demandops, state)
