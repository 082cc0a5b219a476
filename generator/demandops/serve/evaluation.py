"""Decides one demand, or rolls back, on top of the commits of its batch."""

from __future__ import annotations

import logging
from math import inf

from demandops.base.errors import DemandOpsError, InvalidInput, Refused, Withdrawn, fault, internal
from demandops.decide.decision import Decision, Outcome, decide
from demandops.decide.rollback import Restoration
from demandops.model.demand.demand import Demand, Rollback
from demandops.repo.git.repository import StateRepository, disk_error
from demandops.repo.git.signing import SigningFailed
from demandops.repo.history.commit_log import operations_since
from demandops.repo.load.ledger_files import restoration
from demandops.repo.load.snapshot import Snapshot
from demandops.repo.write.commit_batch import CommitBatch
from demandops.serve.approvals.approvals import Approvals, Result
from demandops.serve.demand_lifecycle import TAKEN_BACK, Demands
from demandops.serve.queue import Receipt, Ticket
from demandops.serve.timing.pauses_and_limits import RateLimit, within
from demandops.templating.evaluator import DEMAND_S, processor_time

# ---- one demand; if it fails, the others of the batch continue ----

log = logging.getLogger("demandops")


class Evaluator:
    def __init__(self, repository: StateRepository, demands: Demands, approvals: Approvals) -> None:
        self._repository, self._demands, self._approvals = repository, demands, approvals
        self._rate_limit = RateLimit()

    def evaluate(self, commits: CommitBatch, ticket: Ticket) -> Receipt | DemandOpsError | Decision:
        # A demand that needs approval gets no commit; its result is the decision. A receipt is true
        # only once the batch is published. Errors that concern all demands are raised.
        if ticket.state == "withdrawn":
            return Withdrawn(TAKEN_BACK)
        try:
            demand: Demand = ticket.demand
            if isinstance(demand, Rollback):
                demand = self._restoration(demand, commits.start)
            state = commits.head.state
            # of all services, once for each configuration; that is not this demand's work
            state.usage()
            state.names()
            # what was booked must be released or restored, however long all of it takes
            with processor_time(each=DEMAND_S, together=DEMAND_S if demand.adds_claims else inf):
                decision = decide(
                    state,
                    demand,
                    ticket.received,
                    commits.read,
                    lambda stage: ticket.notify(stage, stage),
                    lambda request, config: self._rate_limit.faults(
                        request, config, ticket.operation, ticket.received
                    ),
                    within(state.config.repo_settings.limits, self._repository.runtime),
                )
            self._approvals.refuse_strangers(decision)
            if decision.approval:
                return decision
            # from here on the demand can no longer be taken back
            if not self._demands.commit(ticket):
                return Withdrawn(TAKEN_BACK)
            self._approvals.withdraw_replaced(decision.request)
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
            return self._approvals.receipt(ticket, decision, commit, state)
        except InvalidInput as error:
            if ticket.has_released:  # the demand released a proposal, which had no claims yet
                commits.record_in_next_commit(ticket.operation, "released")
                commit = str(commits.head.commit)
                return Receipt(ticket.operation, ticket.demand.id, "released", commit)
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

    def _restoration(self, rollback: Rollback, head: Snapshot) -> Restoration:
        to = rollback.to
        if not self._repository.includes(str(head.commit), to):
            message = f"commit {to} is not in the history of the state repo; roll back to one that "
            raise Refused([fault("", f"{message}is")])
        return restoration(self._repository.objects, rollback)

    def published_before(self, tip: str, batch: list[Ticket]) -> list[Result]:
        # Oldest first, the results of those demands that main records already. They have no answer
        # because the process or the connection ended after the push, or because an fsync failed.
        sought = {ticket.operation: ticket for ticket in batch if ticket.maybe_published}
        bases = dict.fromkeys(ticket.base for ticket in sought.values())
        objects = self._repository.objects
        histories = [(base, operations_since(objects, tip, base)) for base in bases]
        # all bases are ancestors of the tip, so the most outcomes are those since the oldest base
        since, recorded = max(histories, key=lambda history: len(history[1]), default=("", {}))
        if published := [operation for operation in reversed(recorded) if operation in sought]:
            # after a failed fsync only files that are written anew are sure to be on the disk
            self._repository.write_anew(since)
        for operation in sought.keys() - published:
            sought[operation].base = tip  # the next search begins here
        results = list[Result]()
        for ticket in (sought[operation] for operation in published):
            record = recorded[ticket.operation]
            if record.outcome == "refused":
                message = "the demand was refused, but the reason was lost; send the demand again"
                results.append((ticket, Refused([fault("", message, code="refused")])))
                continue
            outcome: Outcome = "booked"
            if record.outcome != "changed":
                outcome = record.outcome
            elif ticket.demand.operation == "rollback":
                outcome = "restored"
            elif ticket.demand.is_release or ticket.demand.operation == "decommission":
                outcome = "released"
            receipt = Receipt(ticket.operation, ticket.demand.id, outcome, record.commit)
            results.append((ticket, receipt))
        return results
