"""When the demands that wait for room are tried again, and in which order.

If there may be room, the generator tries the waiting demands before it decides new demands. So no
demand gets the room for which an earlier demand, or a demand of higher priority, was waiting.
"""

from __future__ import annotations

import logging

from demandops.decision import State, decide
from demandops.errors import InvalidInput
from demandops.ledger.waiting import in_turn
from demandops.quoting import quoted
from demandops.runtime import Runtime
from demandops.staterepo.write.commit_batch import CommitBatch

log = logging.getLogger("demandops")


class WaitingTurns:
    """Books waiting demands once there is room for them, in one commit for each."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._tried: State | None = None

    def book_due(self, commits: CommitBatch) -> None:
        """Commit each waiting demand that fits and needs no approval, in its turn.

        The turns are those of :func:`in_turn`.
        Do nothing if all waiting demands were already tried on this state.
        """
        if not self.is_due(commits.head.state):
            return
        for waiting in in_turn(commits.head.state.ledger.waiting):
            now = self._runtime.now()
            try:
                decision = decide(commits.head.state, dict(waiting.goal), now, commits.read)
            except InvalidInput as error:
                log.debug("demand %s still waits: %s", quoted(waiting.demand), error)
                continue
            if decision.outcome == "booked" and not decision.approval:
                commits.commit(decision, self._runtime.fresh_id(), waiting.since, now)
                log.info("demand %s no longer waits", quoted(waiting.demand))
        self._tried = commits.head.state

    def follow(self, commits: CommitBatch, before: State) -> None:
        """Book waiting demands if the last demand freed room.

        ``before`` is the state before the last demand.
        """
        if commits.frees:
            commits.frees = False
            self.book_due(commits)
        elif self._tried is before:  # the last demand freed no room, so the tries are still valid
            self._tried = commits.head.state

    def is_due(self, state: State) -> bool:
        """Return whether there are waiting demands that were not yet tried on this state."""
        tried = self._tried
        return bool(state.ledger.waiting) and not (
            tried is not None and tried.ledger is state.ledger and tried.config is state.config
        )
