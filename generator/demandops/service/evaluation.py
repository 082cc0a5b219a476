"""Evaluates one demand on top of the commits of its batch.

A demand that fails gets the error as its answer. The other demands of the batch continue.
"""

from __future__ import annotations

import logging
from math import inf

from demandops.decision import Decision, Outcome, decide
from demandops.demand.demand_request import Decommission
from demandops.errors import DemandOpsError, InvalidInput, Refused, Withdrawn, fault, internal
from demandops.evaluator.process import DEMAND_S, processor_time
from demandops.service import rollback_goal
from demandops.service.approvals.approvals import Approvals, Result
from demandops.service.approvals.proposal import is_release
from demandops.service.demand_lifecycle import TAKEN_BACK, Demands
from demandops.service.rollout_targets import targets_of_decision
from demandops.service.ticket import Receipt, Ticket, receipt_of
from demandops.service.timing.budget import within
from demandops.service.timing.rate_limit import RateLimit
from demandops.staterepo.git.repository import StateRepository, disk_error
from demandops.staterepo.git.signing import SigningFailed
from demandops.staterepo.history.commit_log import RecordedOutcome, operations_since
from demandops.staterepo.write.commit_batch import CommitBatch

log = logging.getLogger("demandops")


class Evaluator:
    """Evaluates demands in the worker thread."""

    def __init__(
        self,
        repository: StateRepository,
        demands: Demands,
        approvals: Approvals,
        with_targets: bool,
    ) -> None:
        self._repository, self._demands, self._approvals = repository, demands, approvals
        self._with_targets = with_targets
        self._rate_limit = RateLimit()

    def evaluate(self, commits: CommitBatch, ticket: Ticket) -> Receipt | DemandOpsError | Decision:
        """Decide a demand, commit it on the commit batch and return its result.

        Returns:
            The demand's receipt or its error. If the demand needs approval, its decision, without
            a commit. A receipt is true only once the commit batch is published.

        Raises:
            Unavailable, PushDenied, Unsound: if the state repo cannot be written now.
        """
        if ticket.state == "withdrawn":
            return Withdrawn(TAKEN_BACK)
        try:
            goal = ticket.goal
            if rollback_goal.is_rollback(goal):
                goal = rollback_goal.to_restoration(goal, self._repository, commits.start)
            state = commits.head.state
            # of all services, once for each configuration; that is not this demand's work
            state.usage()
            state.names()
            # what was booked must be released or restored, however long all of it takes
            adds = (
                isinstance(goal, dict) and not is_release(goal) and not Decommission.is_goal(goal)
            )
            with processor_time(each=DEMAND_S, together=DEMAND_S if adds else inf):
                decision = decide(
                    state,
                    goal,
                    ticket.received,
                    commits.read,
                    lambda stage: ticket.notify(stage, stage),
                    lambda request, config: self._rate_limit.faults(
                        request, config, ticket.operation, ticket.received
                    ),
                    within(state.config.repo_settings.limits, self._repository.runtime),
                )
            if decision.approval:
                return decision
            if not self._demands.commit(ticket):
                return Withdrawn(TAKEN_BACK)
            self._approvals.withdraw_replaced(decision.request)
            before = commits.head.state
            targets = targets_of_decision(before, decision) if self._with_targets else ()
            if decision.outcome == "waiting":
                ticket.notify("waiting", f"waiting for room: {'; '.join(decision.warnings)}")
            if decision.files:
                now = self._repository.runtime.now()
                commit = commits.commit(decision, ticket.operation, ticket.received, now)
                ticket.notify("committed", f"committed {commit}")
            else:
                waits = decision.outcome == "waiting"  # the demand waited already
                commits.record_in_next_commit(ticket.operation, "waiting" if waits else "unchanged")
                commit = str(commits.head.commit)
            return receipt_of(ticket, decision, commit, targets)
        except InvalidInput as error:
            if ticket.has_released:  # the demand released a proposal, which had no claims yet
                commits.record_in_next_commit(ticket.operation, "released")
                commit = str(commits.head.commit)
                return Receipt(ticket.operation, ticket.name, "released", commit)
            commits.record_in_next_commit(ticket.operation, "refused")
            return error
        except SigningFailed as error:
            return error
        except Exception as error:  # a bug that one demand triggers must not stop the others
            reason = disk_error(error, self._repository.address)
            if reason is not None:  # the state repo fails, so no demand can be evaluated
                raise reason from None
            log.exception("internal error while evaluating demand %s", ticket.operation)
            return internal(error)

    def published_before(self, tip: str, batch: list[Ticket]) -> list[Result]:
        """Return the results of demands that are recorded on main but have no answer yet.

        The demands got no answer because the connection or the process ended after the remote
        accepted the push, or because an fsync failed. In a repository on this disk, this method
        writes and fsyncs the commits of the demands and all later commits once more.

        Args:
            tip: the commit whose history records demands.
            batch: demands, of which some may be recorded already.

        Returns:
            The recorded demands of ``batch``, oldest first, each with its result.

        Raises:
            Unavailable, Unsound: if their commits cannot be written once more.
        """
        sought = {ticket.operation: ticket for ticket in batch if ticket.maybe_published}
        bases = dict.fromkeys(ticket.base for ticket in sought.values())
        found = [(base, operations_since(self._repository.objects, tip, base)) for base in bases]
        # all bases are ancestors of the tip, so the most outcomes are those since the oldest base
        since, recorded = max(found, key=lambda each: len(each[1]), default=("", {}))
        published = [operation for operation in reversed(recorded) if operation in sought]
        if published:
            self._repository.write_anew(since)
        for operation in sought.keys() - published:
            sought[operation].base = tip
        return [
            (sought[one], _receipt_of_published(sought[one], recorded[one])) for one in published
        ]


def _receipt_of_published(ticket: Ticket, arrival: RecordedOutcome) -> Receipt | DemandOpsError:
    if arrival.outcome == "refused":
        message = "the demand was refused, but the reason was lost; send the demand again"
        return Refused([fault("", message, code="refused")])
    goal = ticket.goal
    outcome: Outcome = "booked"
    if arrival.outcome != "changed":
        outcome = arrival.outcome
    elif rollback_goal.is_rollback(goal):
        outcome = "restored"
    elif is_release(goal) or Decommission.is_goal(goal):
        outcome = "released"
    return Receipt(ticket.operation, ticket.name, outcome, arrival.commit)
