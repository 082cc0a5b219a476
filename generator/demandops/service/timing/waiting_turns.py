"""When the demands that wait for room are tried again, and in which order.

If there may be room, the generator tries the waiting demands before it decides new demands. So no
demand gets the room for which an earlier demand, or a demand of higher priority, was waiting.
"""

from __future__ import annotations

import logging

from demandops.decision import State, decide
from demandops.errors import InvalidInput, OverLimit
from demandops.ledger.waiting import in_turn
from demandops.ledger.world import World
from demandops.quoting import quoted
from demandops.runtime import Runtime
from demandops.service.timing.budget import within
from demandops.staterepo.write.commit_batch import CommitBatch

log = logging.getLogger("demandops")

# After this processor time, new demands come before the waiting demands that were not tried yet.
_LONGEST_ROUND_S = 0.25


class WaitingTurns:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._tried: World | None = None
        self._left: list[str] = []

    def book_due(self, commits: CommitBatch) -> None:
        """Commit each waiting demand that fits and needs no approval, in its turn."""
        state = commits.head.state
        if not self.is_due(state):
            return
        if not self._is_tried(state) or not self._left:
            self._left = [waiting.demand for waiting in in_turn(state.ledger.waiting)]
        end = self._runtime.processor_s() + _LONGEST_ROUND_S
        while self._left:
            demand = self._left.pop(0)
            state, now = commits.head.state, self._runtime.now()
            waiting = state.ledger.waiting.get(demand)
            if waiting is None:  # it was released meanwhile
                continue
            checkpoint = within(state.config.repo_settings.limits, self._runtime)
            try:
                decision = decide(
                    state, dict(waiting.goal), now, commits.read, checkpoint=checkpoint
                )
            except InvalidInput as error:
                log.debug("demand %s still waits: %s", quoted(demand), error)
                if isinstance(error, OverLimit):  # a template took too long, and the next may too
                    break
            else:
                if decision.outcome == "booked" and not decision.approval:
                    commits.commit(decision, self._runtime.fresh_id(), waiting.since, now)
                    log.info("demand %s no longer waits", quoted(demand))
            if self._runtime.processor_s() > end:  # after a try, so that each round gets on
                break
        self._tried = commits.head.state

    def follow(self, commits: CommitBatch, before: State) -> None:
        """Book waiting demands if the last demand, decided on ``before``, freed room."""
        if commits.frees:
            commits.frees = False
            self._tried = None
            self.book_due(commits)
        elif self._tried is before:  # the last demand freed no room, so the tries are still valid
            self._tried = commits.head.state

    @property
    def has_more(self) -> bool:
        """Whether the last round left demands for later."""
        return bool(self._left)

    def postpone(self) -> None:
        """Begin again with all waiting demands later."""
        self._left.clear()

    def is_due(self, state: State) -> bool:
        return bool(state.ledger.waiting) and (bool(self._left) or not self._is_tried(state))

    def _is_tried(self, state: World) -> bool:
        # by identity: ledger and configuration are frozen, and to compare their content takes long
        tried = self._tried
        return tried is not None and tried.ledger is state.ledger and tried.config is state.config
