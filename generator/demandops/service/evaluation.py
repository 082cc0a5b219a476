"""Judging: what becomes of one demand on top of a line of commits, or became of it before.

Whatever is wrong with a demand is its answer; nothing that it holds stops the others.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from datetime import datetime, timezone
from typing import TypeAlias

from demandops.decision import Decision, Outcome, decide
from demandops.demand import decommission_goal
from demandops.demand.demand_request import Operation
from demandops.errors import DemandOpsError, InvalidInput, Refused, StateRepoError, Withdrawn, fault
from demandops.service import rollback_goal
from demandops.service.approvals.approvals import RELEASED, Approvals, Deferred
from demandops.service.demand_queue import TAKEN_BACK, DemandQueue
from demandops.service.rollout_targets import targets_of_decision
from demandops.service.ticket import Receipt, Ticket
from demandops.service.timing.rate_limit import RateLimit
from demandops.staterepo.git.repository import StateRepository
from demandops.staterepo.git.signing import SigningFailed
from demandops.staterepo.history import commit_log
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write import commit_line

log = logging.getLogger("demandops")

Result: TypeAlias = tuple[Ticket, Receipt | DemandOpsError | Deferred]


class Evaluator:
    """Judges demands, in the thread that owns the state repo."""

    def __init__(
        self,
        repository: StateRepository,
        waiting: DemandQueue,
        approvals: Approvals,
        with_targets: bool,
    ) -> None:
        self._repository, self._queue, self._approvals = repository, waiting, approvals
        self._with_targets = with_targets
        self._rate_limit = RateLimit()

    def evaluate(
        self,
        line: commit_line.CommitLine,
        ticket: Ticket,
        arrived: dict[str, commit_log.Arrival],
        earlier: list[Result],
    ) -> Receipt | DemandOpsError | Deferred:
        """Decide a demand on top of the line and commit it there.

        Args:
            arrived: what :meth:`arrived` told of its batch.
            earlier: what became of the demands of the batch before it; those that it gives up
                while they await approval are withdrawn there.
        """
        if ticket.state == "withdrawn":
            return Withdrawn(TAKEN_BACK)
        if ticket.operation in arrived:
            return _receipt_of_published(ticket, arrived[ticket.operation])
        try:
            gone = self._approvals.released_in_batch(ticket, line.head.state, earlier)
            earlier[:] = [
                (t, Withdrawn(RELEASED) if t.operation in gone else r) for t, r in earlier
            ]
            goal = ticket.goal
            if rollback_goal.is_rollback(goal):
                goal = rollback_goal.to_restoration(goal, self._repository, line.start)
            decision = decide(
                line.head.state,
                goal,
                ticket.received,
                line.read,
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
            before = line.head.state.ledger
            targets = targets_of_decision(before, decision) if self._with_targets else ()
            return replace(_commit(line, ticket, decision), targets=targets)
        except InvalidInput as error:
            if self._approvals.has_released_a_proposal(
                ticket
            ):  # what was proposed, and nothing else
                line.note(ticket.operation, "Unchanged")
                return _receipt_of_released(ticket, str(line.head.commit))
            line.note(ticket.operation, "Refused")
            return error
        except SigningFailed as error:
            return error
        except Exception as error:  # one demand that the program cannot handle stops no other
            log.exception("a fault of the generator, at demand %s", ticket.operation)
            return StateRepoError(f"a fault of the generator: {error!r}; its log says more")

    def published_before(
        self, start: Snapshot, batch: list[Ticket]
    ) -> dict[str, commit_log.Arrival]:
        """Return operation id → arrival of demands that were published although nobody was told.

        The connection may have been cut, or the process killed, after the remote took the push.
        """
        bases = {ticket.base for ticket in batch if ticket.maybe_published}
        found: dict[str, commit_log.Arrival] = {}
        for base in bases:
            found |= commit_log.operations_since(self._repository.objects, start.commit, base)
        return found


def _commit(line: commit_line.CommitLine, ticket: Ticket, decision: Decision) -> Receipt:
    if decision.files:
        commit = line.commit(decision, ticket.operation, ticket.received, _now())
        ticket.notify("committed", f"committed {commit}")
    else:
        commit = str(line.head.commit)
        line.note(ticket.operation, "Unchanged")
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


def _receipt_of_published(ticket: Ticket, arrival: commit_log.Arrival) -> Receipt | DemandOpsError:
    if arrival.outcome == "refused":
        message = "was refused when the connection was cut; send it again to hear why"
        return Refused([fault("", message, code="refused")])
    goal = ticket.goal if isinstance(ticket.goal, dict) else {}
    gives_up = goal.get("shutdown") or goal.get("operation") == Operation.RELEASE.value
    gives_up = gives_up or decommission_goal.is_decommission(goal)
    outcome: Outcome = "released" if gives_up else "booked"
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


def _now() -> datetime:
    return datetime.now(timezone.utc)
