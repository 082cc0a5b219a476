"""Evaluates one demand on top of the commits of its batch.

A demand that fails gets its error as the answer. The other demands of the batch continue.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from datetime import datetime
from typing import TypeAlias

from demandops.decision import Decision, Outcome, decide
from demandops.demand import decommission_goal
from demandops.errors import DemandOpsError, InvalidInput, Refused, StateRepoError, Withdrawn, fault
from demandops.service import rollback_goal
from demandops.service.approvals.approvals import RELEASED, Approvals, Deferred
from demandops.service.approvals.proposal import is_release
from demandops.service.demand_queue import TAKEN_BACK, DemandQueue
from demandops.service.rollout_targets import targets_of_decision
from demandops.service.ticket import Receipt, Ticket
from demandops.service.timing.rate_limit import RateLimit
from demandops.staterepo.git.repository import StateRepository
from demandops.staterepo.git.signing import SigningFailed
from demandops.staterepo.history import commit_log
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write import commit_batch

log = logging.getLogger("demandops")

Result: TypeAlias = tuple[Ticket, Receipt | DemandOpsError | Deferred]


class Evaluator:
    """Evaluates demands in the worker thread."""

    def __init__(
        self,
        repository: StateRepository,
        queue: DemandQueue,
        approvals: Approvals,
        with_targets: bool,
    ) -> None:
        self._repository, self._queue, self._approvals = repository, queue, approvals
        self._with_targets = with_targets
        self._rate_limit = RateLimit()

    def evaluate(
        self,
        commits: commit_batch.CommitBatch,
        ticket: Ticket,
        published: dict[str, commit_log.RecordedOutcome],
        earlier: list[Result],
    ) -> Receipt | DemandOpsError | Deferred:
        """Decide a demand, commit it on the commit batch and return its result.

        Args:
            published: what :meth:`published_before` returned for the batch.
            earlier: the results of the earlier demands of the batch. A demand that releases one of
                them before it is proposed replaces its result with ``Withdrawn``.
        """
        if ticket.state == "withdrawn":
            return Withdrawn(TAKEN_BACK)
        if ticket.operation in published:
            return _receipt_of_published(ticket, published[ticket.operation])
        try:
            released = self._approvals.released_in_batch(ticket, commits.head.state, earlier)
            earlier[:] = [
                (t, Withdrawn(RELEASED) if t.operation in released else r) for t, r in earlier
            ]
            goal = ticket.goal
            if rollback_goal.is_rollback(goal):
                goal = rollback_goal.to_restoration(goal, self._repository, commits.start)
            decision = decide(
                commits.head.state,
                goal,
                ticket.received,
                commits.read,
                lambda stage: ticket.notify(stage, stage),
                lambda request, config: self._rate_limit.faults(
                    request, config, ticket.operation, ticket.received
                ),
            )
            if decision.approval:
                return Deferred(decision)
            if not self._queue.mark_committed(ticket):
                return Withdrawn(TAKEN_BACK)
            self._approvals.withdraw_replaced(decision.request)
            before = commits.head.state
            now = self._repository.runtime.now()
            targets = targets_of_decision(before, decision) if self._with_targets else ()
            return replace(_commit(commits, ticket, decision, now), targets=targets)
        except InvalidInput as error:
            if self._approvals.has_released_a_proposal(ticket):  # which held no claims yet
                commits.note_settled(ticket.operation, "Unchanged")
                return _receipt_of_released(ticket, str(commits.head.commit))
            commits.note_settled(ticket.operation, "Refused")
            return error
        except SigningFailed as error:
            return error
        except Exception as error:  # a bug that one demand triggers must not stop the others
            log.exception("internal error while evaluating demand %s", ticket.operation)
            return StateRepoError(f"internal error of the generator: {error!r}; see its log")

    def published_before(
        self, start: Snapshot, batch: list[Ticket]
    ) -> dict[str, commit_log.RecordedOutcome]:
        """Return, by operation id, the demands that are published although nobody was answered.

        The connection was cut, or the process was killed, after the remote accepted the push.
        """
        bases = {ticket.base for ticket in batch if ticket.maybe_published}
        published: dict[str, commit_log.RecordedOutcome] = {}
        for base in bases:
            published |= commit_log.operations_since(self._repository.objects, start.commit, base)
        return published


def _commit(
    commits: commit_batch.CommitBatch, ticket: Ticket, decision: Decision, now: datetime
) -> Receipt:
    if decision.files:
        commit = commits.commit(decision, ticket.operation, ticket.received, now)
        ticket.notify("committed", f"committed {commit}")
    else:
        commit = str(commits.head.commit)
        commits.note_settled(ticket.operation, "Unchanged")
    return Receipt(
        operation=ticket.operation,
        request_id=decision.request.id,
        outcome=decision.outcome,
        commit=commit,
        warnings=decision.warnings,
        not_held=decision.changes.not_held,
        lease_s=decision.lease_s,
        changes=decision.changes.claims,
    )


def _receipt_of_published(
    ticket: Ticket, arrival: commit_log.RecordedOutcome
) -> Receipt | DemandOpsError:
    if arrival.outcome == "refused":
        message = "was refused, but the reason was lost with the connection; send it again"
        return Refused([fault("", message, code="refused")])
    goal = ticket.goal if isinstance(ticket.goal, dict) else {}
    releases = is_release(goal) or decommission_goal.is_decommission(goal)
    outcome: Outcome = "released" if releases else "booked"
    if rollback_goal.is_rollback(goal):
        outcome = "restored"
    if arrival.outcome == "unchanged":
        outcome = "unchanged"
    name = goal.get("id") or goal.get("request") or goal.get("demand") or goal.get("name") or ""
    return Receipt(ticket.operation, str(name), outcome, arrival.commit)


def _receipt_of_released(ticket: Ticket, commit: str) -> Receipt:
    goal = ticket.goal
    name = goal.get("id") or goal.get("request") or goal.get("demand") or ""
    return Receipt(ticket.operation, str(name), "released", commit)
