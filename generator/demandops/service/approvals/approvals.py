"""The proposals that await approval, and how each one ends.

Belongs to the worker thread. A proposal is complete once main has its claims, however they got
there. Until then its branch is kept up to date: merging it must give what main would render.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from demandops.decision import Decision, State, decide
from demandops.demand.demand_request import DemandRequest, Put
from demandops.errors import (
    DemandOpsError,
    InvalidInput,
    Refused,
    ShuttingDown,
    TurnedDown,
    Withdrawn,
    fault,
)
from demandops.service.approvals.branch_sync import BranchSync
from demandops.service.approvals.proposal import Key, Proposal, admit_or_none, is_release, key_of
from demandops.service.demand_queue import TAKEN_BACK, DemandQueue
from demandops.service.rollout_targets import targets_of_decision
from demandops.service.ticket import ProposalRecord, Receipt, Ticket
from demandops.staterepo.git.repository import PushDenied, StateRepository
from demandops.staterepo.git.signing import SigningFailed
from demandops.staterepo.history import commit_log
from demandops.staterepo.history.commit_log import RecordedOutcome
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write import commit_batch
from demandops.staterepo.write.proposal_branch import BranchHeads, BranchMoved, branch_name

log = logging.getLogger("demandops")

CHECK_EMBEDDED_S = 1.0
CHECK_REMOTE_S = 5.0
"""The interval between checks of the branches; only a check shows that one was deleted."""
_PAUSE_FACTOR = 9
"""The pause after a check, as a multiple of its duration: checks take a tenth of the time."""

_UNFINISHED = "unfinished"

RELEASED = "was released by a later request before it was approved"
REPLACED = "was replaced by a later demand of the same id before it was approved"


@dataclass(frozen=True, slots=True)
class Deferred:
    """The result of a demand that needs approval."""

    decision: Decision


class Approvals:
    """The proposals that await approval."""

    def __init__(
        self,
        repository: StateRepository,
        queue: DemandQueue,
        with_targets: bool,
        token_file: Path | None,
    ) -> None:
        self._repository = repository
        self._queue = queue
        self._with_targets = with_targets
        self._branch_sync = BranchSync(repository, queue, token_file, self._on_forge_update)
        self._proposals: dict[Key, Proposal] = {}
        self._releasing: set[str] = set()
        self._interval = CHECK_EMBEDDED_S if repository.always_current else CHECK_REMOTE_S
        self._changed: deque[str] = deque()
        self._checked_at, self._check_began, self._rest_until, self._next_check = "", 0.0, 0.0, 0.0

    # ---- while a batch is evaluated ----

    def resume(self, batch: list[Ticket], state: State) -> None:
        """Move the demands that an earlier run proposed from the batch to their proposals."""
        for ticket in [ticket for ticket in batch if ticket.proposal is not None]:
            batch.remove(ticket)
            request = admit_or_none(state, ticket.goal)
            record = ticket.proposal or ProposalRecord("")
            proposal = next(
                (p for p in self._proposals.values() if p.branch == record.branch), None
            )
            if proposal is None:
                key = key_of(request) if request else ("operation", ticket.operation)
                if key in self._proposals:  # an earlier run proposed the same demand
                    key = ("operation", ticket.operation)
                proposal = self._proposals[key] = Proposal(key, record, searched_to=ticket.base)
            proposal.tickets.append(ticket)
            proposal.requests += [request] if request else []
            self._changed.append(proposal.branch)

    def remove_released(self, batch: Iterable[Ticket], state: State) -> None:
        """Remove the proposals that demands of the batch release, before these are evaluated.

        Once its branch is deleted, nobody can merge a proposal. If it was merged before, it is on
        the tip on which the demands are evaluated next.

        Raises:
            RemoteAway, PushDenied: if the branch could not be deleted.
        """
        for ticket in batch if self._proposals else ():
            request = admit_or_none(state, ticket.goal) if is_release(ticket.goal) else None
            if request is None:
                continue
            for proposal in [p for p in self._proposals.values() if p.is_released_by(request)]:
                self._queue.withdraw_proposed(proposal.tickets, RELEASED)
                self._branch_sync.delete(proposal, self._branch_sync.fetch_heads())
                self._queue.answer((old, Withdrawn(RELEASED)) for old in proposal.tickets)
                self._forget(proposal, close=True)
                self._releasing.add(ticket.operation)

    def released_in_batch(
        self, ticket: Ticket, state: State, earlier: Iterable[tuple[Ticket, object]]
    ) -> set[str]:
        """Return the operation ids of the earlier demands that a demand releases."""
        request = admit_or_none(state, ticket.goal) if is_release(ticket.goal) else None
        if request is None:
            return set()
        released = {
            other.operation
            for other, result in earlier
            if isinstance(result, Deferred)
            and _proposal_of(other, result.decision).is_released_by(request)
        }
        if released:
            self._releasing.add(ticket.operation)
        return released

    def has_released_a_proposal(self, ticket: Ticket) -> bool:
        """Return whether a demand released a proposal; then it may hold no claims."""
        return ticket.operation in self._releasing

    def add(self, ticket: Ticket, decision: Decision) -> None:
        """Add a demand that needs approval, to an existing proposal of the same demand if any."""
        request, key = decision.request, key_of(decision.request)
        proposal = self._proposals.get(key)
        if proposal is not None and not proposal.requesters() & set(request.requesters()):
            owners = ", ".join(sorted(proposal.requesters()))
            message = f"'{request.demand}' is a demand of {owners}; choose another demand id"
            self._queue.answer([(ticket, Refused([fault("demand", message, code="not-yours")]))])
            return
        if proposal is None:
            branch = branch_name(request.demand or request.id, ticket.operation)
            proposal = Proposal(key, ProposalRecord(branch), searched_to=ticket.base)
        elif isinstance(request, Put) and request not in proposal.requests:
            replaced, proposal.tickets, proposal.requests = proposal.tickets, [], []
            self._queue.answer((old, Withdrawn(REPLACED)) for old in replaced)
        if not self._queue.set_proposal(ticket, proposal.record):
            self._queue.answer([(ticket, Withdrawn(TAKEN_BACK))])
            return
        self._proposals[key] = proposal
        proposal.tickets.append(ticket)
        proposal.requests.append(request)
        self._changed.append(proposal.branch)

    def withdraw_replaced(self, request: DemandRequest) -> None:
        """Withdraw the proposal of a demand that was put again and needs no approval now."""
        proposal = self._proposals.get(key_of(request))
        if proposal is not None and isinstance(request, Put):
            self._queue.withdraw_proposed(proposal.tickets, REPLACED)

    # ---- after main was read ----

    def is_due(self, tip: str) -> bool:
        """Return whether to check the proposals now, with main at ``tip``."""
        if not self._proposals:
            return False
        now = self._repository.runtime.monotonic()
        if now < self._next_check and self._checked_at == _UNFINISHED:
            return False
        tickets = (ticket for p in self._proposals.values() for ticket in p.tickets)
        if self._changed or any(ticket.state == "withdrawn" for ticket in tickets):
            return True
        if tip != self._checked_at and now < self._rest_until:
            self._next_check = min(self._next_check, self._rest_until)
        return now >= self._next_check or (tip != self._checked_at and now >= self._rest_until)

    def seconds_until_due(self, longest: float) -> float:
        """Return the seconds until the next check; ``longest`` without proposals."""
        if not self._proposals:
            return longest
        return min(longest, max(self._next_check - self._repository.runtime.monotonic(), 0.05))

    def fetch_heads(self) -> BranchHeads:
        """Fetch the commits of the branches, and plan the next check even if this one fails."""
        self._check_began = self._repository.runtime.monotonic()
        self._next_check, self._checked_at = self._check_began + self._interval, _UNFINISHED
        return self._branch_sync.fetch_heads()

    def check(self, snapshot: Snapshot, heads: BranchHeads) -> None:
        """Answer the proposals that are decided or withdrawn, and update the others.

        Args:
            snapshot: main, no older than ``heads``.
            heads: the commits of the branches.

        Raises:
            RemoteAway: if the remote cannot be reached; the next check continues.
        """
        while self._changed:
            branch = self._changed.popleft()
            for proposal in self._proposals.values():
                if proposal.branch == branch:
                    proposal.checked_at = ""
        for proposal in list(self._proposals.values()):
            try:
                if not proposal.is_unchanged(str(snapshot.commit), heads.branches):
                    self._check(proposal, snapshot, heads)
            except BranchMoved as error:
                log.info("%s; checking again", error)
                self._changed.append(proposal.branch)
            except SigningFailed as error:
                if proposal.record.pushed:  # the existing branch can still be merged
                    log.warning("%s; %s is not rebuilt", error, proposal.branch)
                else:
                    self._fail(proposal, error)
            except PushDenied as error:
                self._fail(proposal, error)
        ended = self._repository.runtime.monotonic()
        self._checked_at, self._rest_until = (
            str(snapshot.commit),
            ended + _PAUSE_FACTOR * (ended - self._check_began),
        )

    def _fail(self, proposal: Proposal, error: DemandOpsError) -> None:
        self._queue.answer([(ticket, error) for ticket in proposal.tickets])
        self._forget(proposal, close=True)

    def _check(self, proposal: Proposal, snapshot: Snapshot, heads: BranchHeads) -> None:
        objects = self._repository.objects
        arrived = commit_log.operations_since(objects, snapshot.commit, proposal.searched_to)
        proposal.searched_to = str(snapshot.commit)
        results = [(t, self._result(t, snapshot, arrived)) for t in proposal.tickets]
        done = [(t, v) for t, v in results if isinstance(v, Receipt)]
        self._queue.answer(done)
        proposal.tickets = [t for t, v in results if not isinstance(v, Receipt)]
        errors = [(t, v) for t, v in results if isinstance(v, DemandOpsError)]
        left = [(t, v) for t, v in results if isinstance(v, Decision) and v.approval]
        free = [t for t, v in results if isinstance(v, Decision) and not v.approval]
        why_not = "" if done else self._branch_sync.turned_down_because(proposal, heads)
        if why_not:
            errors += [(ticket, TurnedDown(why_not)) for ticket, _ in left]
            left = []
        if not left:
            self._branch_sync.delete(proposal, heads, if_unchanged=bool(done))
        self._queue.answer(errors)
        self._queue.requeue(free)
        proposal.tickets = [ticket for ticket, _ in left]
        if not left:
            self._forget(proposal, close=not done)
            return
        if done and proposal.branch not in heads.branches:  # only a part was merged
            proposal.record = replace(proposal.record, pushed=False)
        head = heads.branches.get(proposal.branch, "")
        if self._branch_sync.update(proposal, left, snapshot, head):
            proposal.checked_at = str(snapshot.commit)
        else:
            self._changed.append(proposal.branch)

    def _result(
        self, ticket: Ticket, snapshot: Snapshot, arrived: dict[str, RecordedOutcome]
    ) -> Receipt | DemandOpsError | Decision:
        """Return the receipt or error of a demand that is decided, else its decision on main.

        It is booked if the history of main has its operation id, or if the ledger has its claims:
        a squash merge may lose the trailer.
        """
        read = commit_batch.CommitBatch(self._repository, snapshot).read
        decision: Decision | DemandOpsError
        try:
            decision = decide(snapshot.state, ticket.goal, ticket.received, read)
        except InvalidInput as error:
            decision = error
        arrival = arrived.get(ticket.operation)
        if arrival is not None or (isinstance(decision, Decision) and not decision.files):
            commit = arrival.commit if arrival else str(snapshot.commit)
            return self._receipt(ticket, decision, snapshot.state, commit)
        if ticket.state == "withdrawn" and ticket.proposal:
            return Withdrawn(ticket.proposal.withdrawn or TAKEN_BACK)
        return decision

    def _receipt(
        self, ticket: Ticket, decision: Decision | DemandOpsError, state: State, commit: str
    ) -> Receipt:
        if not isinstance(decision, Decision) or decision.files:  # merged, and changed since
            goal = ticket.goal if isinstance(ticket.goal, dict) else {}
            name = goal.get("id") or goal.get("request") or goal.get("demand") or ""
            return Receipt(ticket.operation, str(name), "booked", commit)
        return Receipt(
            operation=ticket.operation,
            request_id=decision.request.id,
            outcome="booked",
            commit=commit,
            warnings=decision.warnings,
            lease_s=decision.lease_s,
            targets=targets_of_decision(state, decision) if self._with_targets else (),
        )

    def _forget(self, proposal: Proposal, *, close: bool) -> None:
        self._proposals = {k: p for k, p in self._proposals.items() if p is not proposal}
        self._branch_sync.forget(proposal, close=close)

    # ---- updates and the end ----

    def _on_forge_update(self, branch: str) -> None:
        """Check a branch again, because the forge answered; from the forge worker's thread."""
        self._changed.append(branch)
        self._queue.wake()

    def suspend(self) -> None:
        """Answer all demands that await approval; the journal keeps them for the next start."""
        error = ShuttingDown("awaits approval; it is resumed at the next start")
        for proposal in self._proposals.values():
            self._queue.fail(proposal.tickets, error, keep=True)
        self._proposals = {}


def _proposal_of(ticket: Ticket, decision: Decision) -> Proposal:
    """Return a proposal with one demand."""
    request = decision.request
    return Proposal(key_of(request), ProposalRecord(""), [ticket], [request])
