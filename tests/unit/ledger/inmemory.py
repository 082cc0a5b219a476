"""A state repo of plain dicts, to decide requests on without Git."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime, timedelta, timezone
from functools import lru_cache
from typing import Any

from demandops.config.config import CONFIG_ROOTS
from demandops.config.load import load
from demandops.decision import Decision, State, decide
from demandops.errors import Refused
from demandops.ledger.apply import Ledger
from demandops.plan.views.bookkeeping import as_data, bookkeeping
from demandops.staterepo import new_repo

from tests.model.books import Goal, in_model_words, object_lists

NOW = datetime(2026, 1, 31, 12, tzinfo=timezone.utc)


@lru_cache
def skeleton() -> tuple[State, Mapping[str, str]]:
    """Return what `demandops init` lays down: the state, and every file."""
    files = new_repo.files()
    config = {path: text for path, text in files.items() if path.split("/")[0] in CONFIG_ROOTS}
    return State.of(load(config), Ledger()), files


class Repo:
    """A state repo in memory: its state, and its files as the commits so far leave them."""

    def __init__(self) -> None:
        state, files = skeleton()
        self.state = state
        self.files = dict(files)

    def decide(self, goal: Goal, now: datetime = NOW) -> Decision:
        """Decide a goal against what stands; nothing changes.

        Raises:
            Refused: where it is not honoured.
        """
        return decide(self.state, goal, now, self.files.get)

    def take(self, goal: Goal, now: datetime = NOW) -> Decision | Refused:
        """Decide a goal and commit what comes of it, or return the refusal."""
        try:
            decision = self.decide(goal, now)
        except Refused as refusal:
            return refusal
        self.state = decision.state
        for path, text in decision.files.items():
            if text is None:
                assert path in self.files, f"removed though it is not there: {path}"
                del self.files[path]
            else:
                assert self.files.get(path) != text, f"written again as it was: {path}"
                self.files[path] = text
        return decision

    def take_all(self, goals: Iterable[Goal]) -> list[str]:
        """Take goals in order, each a minute after the other, and return the outcomes."""
        return [
            outcome(self.take(goal, NOW + timedelta(minutes=minute)))
            for minute, goal in enumerate(goals)
        ]

    def below(self, *roots: str) -> dict[str, str]:
        """Return the files of some of the repo's folders, without the notes for people."""
        return {
            path: text
            for path, text in self.files.items()
            if path.split("/")[0] in roots and not path.endswith("/README.md")
        }

    def view(self) -> dict[str, Any]:
        """Return the bookkeeping, in the model's words."""
        data = as_data(bookkeeping(self.state.ledger, self.state.config), "")
        return in_model_words(data, object_lists(self.below("clusters").values()))


def outcome(taken: Decision | Refused) -> str:
    """Return what became of a goal, in one word."""
    return "refused" if isinstance(taken, Refused) else taken.outcome
