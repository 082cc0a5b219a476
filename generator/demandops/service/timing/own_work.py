"""The work that becomes due without a new demand, such as ends of overrides."""

from __future__ import annotations

from demandops.decision import State
from demandops.runtime import Runtime
from demandops.service.timing.draining import Draining
from demandops.service.timing.expiry import OverrideExpiry, ScaleDown
from demandops.service.timing.waiting_turns import WaitingTurns
from demandops.staterepo.write.commit_batch import CommitBatch


class OwnWork:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._override_expiry = OverrideExpiry()
        self._scale_down = ScaleDown()
        self._draining = Draining(runtime)
        self._waiting_turns = WaitingTurns(runtime)

    def commit_due(self, commits: CommitBatch) -> None:
        """Commit all work that is due; if a part fails, try it again later."""
        # a scale-down frees room for what moves, and what runs moves before what waits is booked
        self._override_expiry.end_due(commits, self._runtime.now())
        self._scale_down.end_due(commits, self._runtime.now())
        self._draining.move_due(commits)
        self._waiting_turns.book_due(commits)

    def follow(self, commits: CommitBatch, before: State) -> None:
        """Book waiting demands if the last demand, decided on ``before``, freed room."""
        self._waiting_turns.follow(commits, before)

    def postpone(self) -> None:
        """Begin no work for a while, because a fetch or a publication failed."""
        self._override_expiry.postpone(self._runtime.now())
        self._scale_down.postpone(self._runtime.now())
        self._draining.postpone()
        self._waiting_turns.postpone()

    def is_due(self, state: State) -> bool:
        now = self._runtime.now()
        return (
            self._override_expiry.is_due(state, now)
            or self._scale_down.is_due(state.ledger, now)
            or self._draining.is_due(state)
            or self._waiting_turns.is_due(state)
        )

    def seconds_until_due(self, state: State, longest: float) -> float:
        """Return the seconds until the next check: at most ``longest``."""
        # what was left off goes on at once, but after the demands that arrived meanwhile
        if self._draining.has_more or self._waiting_turns.has_more:
            return 0.0
        now = self._runtime.now()
        seconds = self._override_expiry.seconds_until_due(state, now, longest)
        return self._scale_down.seconds_until_due(state.ledger, now, seconds)
