"""Approval: demands that wait until a person merges their branch, turns them down, or they go.

Belongs to the thread that settles demands. A proposal is complete when main holds what it asks,
however it came there; until then it is kept such that merging it gives what main would render.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from demandops.decision import Decision, State, decide
from demandops.demand.demand_request import DemandRequest, Operation
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
from demandops.staterepo.history.commit_log import Arrival
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write import commit_line
from demandops.staterepo.write.proposal_branch import BranchMoved, Heads, branch_of

log = logging.getLogger("demandops")

CHECK_EMBEDDED_S = 1.0
CHECK_REMOTE_S = 5.0
"""Between two looks at the branches: that one was deleted shows nowhere else."""
_SHARE = 9
"""Comparing proposals with a main that keeps moving may take a tenth of the time, not more."""

_UNFINISHED = "trouble"

RELEASED = "was given up by a later request before it was approved"
REPLACED = "was replaced by a later demand of the same id before it was approved"


@dataclass(frozen=True, slots=True)
class Deferred:
    """What comes of a demand for now: it needs approval."""

    decision: Decision


class Approvals:
    """The proposals that wait, and what is done about them."""

    def __init__(
        self,
        repository: StateRepository,
        waiting: DemandQueue,
        with_targets: bool,
        token_file: Path | None,
    ) -> None:
        self._repository = repository
        self._queue = waiting
        self._with_targets = with_targets
        self._branch_sync = BranchSync(repository, waiting, token_file, self._on_forge_update)
        self._proposals: dict[Key, Proposal] = {}
        self._releasing: set[str] = set()
        self._interval = CHECK_EMBEDDED_S if repository.always_current else CHECK_REMOTE_S
        self._changed: deque[str] = deque()
        self._checked_at, self._check_began, self._rest_until, self._next_check = "", 0.0, 0.0, 0.0

    # ---- while a batch is judged ----

    def resume(self, batch: list[Ticket], state: State) -> None:
        """Take out of a batch what an earlier run has proposed already."""
        for ticket in [ticket for ticket in batch if ticket.proposal is not None]:
            batch.remove(ticket)
            request = admit_or_none(state, ticket.goal)
            record = ticket.proposal or ProposalRecord("")
            ticket.state = "withdrawn" if record.withdrawn else ticket.state
            proposal = next(
                (p for p in self._proposals.values() if p.branch == record.branch), None
            )
            if proposal is None:
                key = key_of(request) if request else ("operation", ticket.operation)
                if key in self._proposals:  # another run's, of the same demand
                    key = ("operation", ticket.operation)
                proposal = self._proposals[key] = Proposal(key, record, searched_to=ticket.base)
            proposal.tickets.append(ticket)
            proposal.requests += [request] if request else []
            self._changed.append(proposal.branch)

    def remove_released(self, batch: Iterable[Ticket], state: State) -> None:
        """Take away proposals that demands of the batch give up, before these are judged.

        Once its branch is gone nobody can merge it; what was merged before is on the tip that the
        demands are judged on next.

        Raises:
            RemoteAway, PushDenied: where the branch could not be taken away.
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
        """Return the operations of this pass that a demand gives up before they are proposed."""
        request = admit_or_none(state, ticket.goal) if is_release(ticket.goal) else None
        if request is None:
            return set()
        found = {
            other.operation
            for other, result in earlier
            if isinstance(result, Deferred)
            and _alone(other, result.decision).is_released_by(request)
        }
        if found:
            self._releasing.add(ticket.operation)
        return found

    def has_released_a_proposal(self, ticket: Ticket) -> bool:
        """Tell whether a demand gave a proposal up: then it is no fault that it holds nothing."""
        return ticket.operation in self._releasing

    def add(self, ticket: Ticket, decision: Decision) -> None:
        """Take in a demand that needs approval; one of the same demand waits with it."""
        request, key = decision.request, key_of(decision.request)
        proposal = self._proposals.get(key)
        if proposal is not None and not proposal.requesters() & set(request.requesters()):
            owners = ", ".join(sorted(proposal.requesters()))
            message = f"'{request.demand}' is a demand of {owners}; choose another demand id"
            self._queue.answer([(ticket, Refused([fault("demand", message, code="not-yours")]))])
            return
        if proposal is None:
            branch = branch_of(request.demand or request.id, ticket.operation)
            proposal = Proposal(key, ProposalRecord(branch), searched_to=ticket.base)
        elif request.operation is Operation.PUT and request not in proposal.requests:
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
        """Give up the proposal of a demand that was put anew and needs no approval."""
        proposal = self._proposals.get(key_of(request))
        if proposal is not None and request.operation is Operation.PUT:
            self._queue.withdraw_proposed(proposal.tickets, REPLACED)

    # ---- after main was taken in ----

    def is_due(self, tip: str) -> bool:
        """Tell whether to look at the proposals now, with main at ``tip``."""
        if not self._proposals:
            return False
        now = time.monotonic()
        if now < self._next_check and self._checked_at == _UNFINISHED:
            return False
        tickets = (ticket for p in self._proposals.values() for ticket in p.tickets)
        if self._changed or any(ticket.state == "withdrawn" for ticket in tickets):
            return True
        if tip != self._checked_at and now < self._rest_until:
            self._next_check = min(self._next_check, self._rest_until)
        return now >= self._next_check or (tip != self._checked_at and now >= self._rest_until)

    def seconds_until_due(self, longest: float) -> float:
        """Return the seconds until the next look is due, ``longest`` where nothing waits."""
        if not self._proposals:
            return longest
        return min(longest, max(self._next_check - time.monotonic(), 0.05))

    def fetch_heads(self) -> Heads:
        """Ask where the branches are; the next look is due after a while, whatever comes."""
        self._check_began = time.monotonic()
        self._next_check, self._checked_at = self._check_began + self._interval, _UNFINISHED
        return self._branch_sync.fetch_heads()

    def check(self, snapshot: Snapshot, heads: Heads) -> None:
        """Look at each proposal: is it decided, does it go, does it still fit main?

        Args:
            snapshot: main, no older than ``heads``.
            heads: where the branches are.

        Raises:
            RemoteAway: where the remote does not answer any more; the rest is for the next time.
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
                log.info("%s; looking again", error)
                self._changed.append(proposal.branch)
            except SigningFailed as error:
                if proposal.record.pushed:  # it stands as it is, and may be merged
                    log.warning("%s; %s is not laid anew", error, proposal.branch)
                else:
                    self._fail(proposal, error)
            except PushDenied as error:
                self._fail(proposal, error)
        ended = time.monotonic()
        self._checked_at, self._rest_until = (
            str(snapshot.commit),
            ended + _SHARE * (ended - self._check_began),
        )

    def _fail(self, proposal: Proposal, error: DemandOpsError) -> None:
        self._queue.answer([(ticket, error) for ticket in proposal.tickets])
        self._forget(proposal, close=True)

    def _check(self, proposal: Proposal, snapshot: Snapshot, heads: Heads) -> None:
        objects = self._repository.objects
        arrived = commit_log.operations_since(objects, snapshot.commit, proposal.searched_to)
        proposal.searched_to = str(snapshot.commit)
        verdicts = [(t, self._verdict(t, snapshot, arrived)) for t in proposal.tickets]
        done = [(t, v) for t, v in verdicts if isinstance(v, Receipt)]
        self._queue.answer(done)
        proposal.tickets = [t for t, v in verdicts if not isinstance(v, Receipt)]
        errors = [(t, v) for t, v in verdicts if isinstance(v, DemandOpsError)]
        left = [(t, v) for t, v in verdicts if isinstance(v, Decision) and v.approval]
        free = [t for t, v in verdicts if isinstance(v, Decision) and not v.approval]
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
        if done and proposal.branch not in heads.branches:  # what was not merged goes on
            proposal.record = replace(proposal.record, pushed=False)
        head = heads.branches.get(proposal.branch, "")
        if self._branch_sync.update(proposal, left, snapshot, head):
            proposal.checked_at = str(snapshot.commit)
        else:
            self._changed.append(proposal.branch)

    def _verdict(
        self, ticket: Ticket, snapshot: Snapshot, arrived: dict[str, Arrival]
    ) -> Receipt | DemandOpsError | Decision:
        """Return what became of a demand: booked, refused, taken back, or how it still stands.

        It is booked where main's history has its operation, or main's books hold what it asks: a
        squash may lose the trailer, and never the claims.
        """
        read = commit_line.CommitLine(self._repository, snapshot).read
        decision: Decision | DemandOpsError
        try:
            decision = decide(snapshot.state, ticket.goal, ticket.received, read)
        except InvalidInput as error:
            decision = error
        here = arrived.get(ticket.operation)
        if here is not None or (isinstance(decision, Decision) and not decision.files):
            commit = here.commit if here else str(snapshot.commit)
            return self._receipt(ticket, decision, snapshot.state, commit)
        if ticket.state == "withdrawn" and ticket.proposal:
            return Withdrawn(ticket.proposal.withdrawn or TAKEN_BACK)
        return decision

    def _receipt(
        self, ticket: Ticket, decision: Decision | DemandOpsError, state: State, commit: str
    ) -> Receipt:
        if not isinstance(decision, Decision) or decision.files:  # merged, and undone since
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
            targets=targets_of_decision(state.ledger, decision) if self._with_targets else (),
        )

    def _forget(self, proposal: Proposal, *, close: bool) -> None:
        self._proposals = {k: p for k, p in self._proposals.items() if p is not proposal}
        self._branch_sync.forget(proposal, close=close)

    # ---- the end ----

    def _on_forge_update(self, branch: str) -> None:
        """Have the answer of a forge told; from the desk's thread."""
        self._changed.append(branch)
        self._queue.wake()

    def suspend(self) -> None:
        """Answer all that waits; the journal keeps it for the next start."""
        error = ShuttingDown("awaits approval; it is taken up again at the next start")
        for proposal in self._proposals.values():
            self._queue.fail(proposal.tickets, error, keep=True)
        self._proposals = {}


def _alone(ticket: Ticket, decision: Decision) -> Proposal:
    """Return the proposal that a demand would be by itself."""
    request = decision.request
    return Proposal(key_of(request), ProposalRecord(""), [ticket], [request])
