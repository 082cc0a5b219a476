"""The proposals that await approval, and the answers to their demands.

This code runs in the worker thread. A proposal is booked once main has its claims, whether by a
merge commit, a squash or a rebase. Until then the worker rebuilds the branch if a new main makes
it outdated, so that the branch has the files that the generator would render on that main. A branch
to which a person has committed stays unchanged.
:meth:`Proposal.verdict` decides what happens to the demands of a proposal, and this module carries
that verdict out.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from demandops.decision import Decision, State
from demandops.demand.claim import ClaimKey
from demandops.demand.demand_request import DemandRequest, Put
from demandops.errors import DemandOpsError, InvalidInput, Refused, ShuttingDown, Withdrawn, fault
from demandops.quoting import quoted
from demandops.service.approvals.check_timer import CheckTimer
from demandops.service.approvals.forge_worker import ForgeWorker
from demandops.service.approvals.proposal import (
    Key,
    Proposal,
    Verdict,
    admit_or_none,
    decide_in_turn,
    is_release,
    key_of,
    pull_request_body,
    push_options,
    releases,
    title_of,
    waiting_text,
)
from demandops.service.demand_lifecycle import TAKEN_BACK, Demands
from demandops.service.rollout_targets import targets_of_decision
from demandops.service.ticket import Receipt, Ticket, receipt_of
from demandops.settings import PROPOSAL_LIMIT
from demandops.staterepo.git.repository import PushDenied, StateRepository
from demandops.staterepo.git.signing import SigningFailed
from demandops.staterepo.history import commit_log
from demandops.staterepo.history.commit_log import RecordedOutcome
from demandops.staterepo.load import ledger_files
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write.commit_batch import CommitBatch
from demandops.staterepo.write.journal import ProposalRecord
from demandops.staterepo.write.proposal_branch import (
    BranchHeads,
    BranchMoved,
    ProposalBranches,
    branch_name,
)

log = logging.getLogger("demandops")

_LONGEST_CHECK_S = 0.5
"""How many seconds a check of all proposals may take before it pauses for a queued demand."""

RELEASED = "was released by a later request before it was approved"
REPLACED = "was replaced by a later demand of the same id before it was approved"


Result: TypeAlias = tuple[Ticket, Receipt | DemandOpsError | Decision]
"""A demand with its result: a receipt, an error, or the decision if the demand needs approval."""


class Approvals:
    """Keeps, updates and ends the proposals that await approval."""

    def __init__(
        self,
        repository: StateRepository,
        state: State,
        demands: Demands,
        with_targets: bool,
        token_file: Path | None,
    ) -> None:
        """Resume the proposals of an earlier run; ``state`` is the state of main."""
        self._repository, self._runtime = repository, repository.runtime
        self._demands = demands
        self._with_targets = with_targets
        self._branches = ProposalBranches(repository)
        self._forge = ForgeWorker(token_file, self._on_forge_update, repository.runtime)
        self._timer = CheckTimer(repository.runtime, local=repository.always_current)
        self._proposals: dict[Key, Proposal] = {}
        self._changed: deque[str] = deque()
        for ticket in demands.proposed:
            self._resume(ticket, admit_or_none(state, ticket.goal))

    def _resume(self, ticket: Ticket, request: DemandRequest | None) -> None:
        record = replace(ticket.proposal or ProposalRecord(""), withdrawn="")
        proposal = next((p for p in self._proposals.values() if p.branch == record.branch), None)
        if proposal is None:
            key = key_of(request) if request else ("operation", ticket.operation)
            if key in self._proposals:  # the earlier run left another branch with the same key
                key = ("operation", ticket.operation)
            proposal = self._proposals[key] = Proposal(key, record, searched_to=ticket.base)
        if ticket.state == "proposed":  # a withdrawn ticket has an older record
            proposal.record = record
        proposal.tickets.append(ticket)
        proposal.requests += [request] if request else []
        self._changed.append(proposal.branch)

    # ---- while a batch is evaluated ----

    def remove_released(self, batch: Iterable[Ticket], state: State) -> None:
        """Withdraw each proposal that a demand of ``batch`` releases, and delete its branch.

        The worker calls this before it evaluates the batch. After the deletion nobody can merge
        the proposal. If a person merged it earlier, the batch is evaluated on a tip that includes
        the merge.

        Raises:
            RemoteAway, PushDenied, BranchMoved: if the branch could not be deleted.
        """
        for ticket in batch if self._proposals else ():
            request = _release_request(ticket, state)
            if request is None:
                continue
            for proposal in [p for p in self._proposals.values() if releases(request, p.requests)]:
                self._demands.withdraw_proposed(proposal.tickets, RELEASED)
                self._delete_branch(proposal, self._branches.heads())
                # the next check answers the demands, because their branch may be merged already
                self._changed.append(proposal.branch)
                ticket.has_released = True

    def withdraw_released(self, earlier: list[Result], by: Ticket, state: State) -> None:
        """Withdraw each demand in ``earlier`` that needs approval, if ``by`` releases the demand.

        Args:
            earlier: the demands of the batch that are evaluated already, with their results. For a
                withdrawn demand, the result is replaced by :class:`Withdrawn`.
            by: the next demand of the batch, of any kind.
            state: the state on which ``by`` will be evaluated.
        """
        request = _release_request(by, state) if earlier else None
        for index, (ticket, result) in enumerate(earlier):
            if request and isinstance(result, Decision) and releases(request, [result.request]):
                earlier[index] = (ticket, Withdrawn(RELEASED))
                by.has_released = True

    def add(self, ticket: Ticket, decision: Decision) -> None:
        """Add a demand to the proposal that has the demand's key, or to a new proposal.

        A put with other content replaces the earlier demands of its proposal. The demand gets an
        error as its answer if other requesters own the proposal, if a requester has too many
        proposals, or if the demand was withdrawn.
        """
        request, key = decision.request, key_of(decision.request)
        proposal = self._proposals.get(key)
        if proposal is not None and not proposal.requesters() & set(request.requesters()):
            owners = ", ".join(sorted(proposal.requesters()))
            message = f"'{request.demand}' is a demand of {owners}; choose another demand id"
            self._demands.fail([ticket], Refused([fault("demand", message, code="not-yours")]))
            return
        if proposal is None and (full := self._requester_over_limit(request)):
            message = (
                f"requester {quoted(full)} already has {PROPOSAL_LIMIT} proposals that await "
                "approval; release some of the demands in these proposals, or ask a person to "
                "approve or reject some of the proposals"
            )
            self._demands.fail([ticket], Refused([fault("", message, code="quota")]))
            return
        if proposal is None:
            branch = branch_name(request.demand or request.id, ticket.operation)
            proposal = Proposal(key, ProposalRecord(branch), searched_to=ticket.base)
        elif isinstance(request, Put) and request not in proposal.requests:
            # the next check answers the withdrawn demands: a person may have merged them meanwhile
            self._demands.withdraw_proposed(proposal.tickets, REPLACED)
            proposal.requests = []
        if proposal.tickets and all(ticket.state == "withdrawn" for ticket in proposal.tickets):
            # a release may have deleted the branch, and nobody can turn down what was not on it
            proposal.record = replace(proposal.record, pushed=False)
        if not self._demands.propose(ticket, proposal.record):
            self._demands.fail([ticket], Withdrawn(TAKEN_BACK))
            return
        self._proposals[key] = proposal
        proposal.tickets.append(ticket)
        proposal.requests.append(request)
        self._changed.append(proposal.branch)

    def _requester_over_limit(self, request: DemandRequest) -> str:
        counts = Counter(name for each in self._proposals.values() for name in each.requesters())
        full = (name for name in request.requesters() if counts[name] >= PROPOSAL_LIMIT)
        return next(full, "")

    def withdraw_replaced(self, request: DemandRequest) -> None:
        """Withdraw the open proposal that ``request`` replaces, if ``request`` is a put.

        The caller has found that ``request`` needs no approval.
        """
        proposal = self._proposals.get(key_of(request))
        if proposal is not None and isinstance(request, Put):
            self._demands.withdraw_proposed(proposal.tickets, REPLACED)

    # ---- after main was read ----

    def is_due(self, tip: str) -> bool:
        """Return whether to check the proposals now; ``tip`` is the newest commit of main."""
        if not self._proposals:
            return False
        tickets = (ticket for p in self._proposals.values() for ticket in p.tickets)
        withdrawn = any(ticket.state == "withdrawn" for ticket in tickets)
        return self._timer.is_due(tip, has_news=bool(self._changed) or withdrawn)

    def seconds_until_due(self, tip: str, longest: float) -> float:
        """Return the seconds until the next check, at most ``longest``."""
        if not self._proposals:
            return longest
        return min(longest, max(self._timer.seconds_until_due(tip), 0.05))

    def fetch_heads(self) -> BranchHeads:
        """Return the newest commits of main and of the proposals' branches, as they are now.

        The next check is planned first, in case the fetch fails.

        Raises:
            RemoteAway: if the remote cannot be reached.
        """
        self._timer.began()
        return self._branches.heads()

    def check(self, snapshot: Snapshot, heads: BranchHeads) -> None:
        """Answer the demands that are decided or withdrawn, and update the other proposals.

        If a demand is queued, a long check stops early, and the next check does the rest.

        Args:
            snapshot: the state of main, at the commit ``heads.main`` or a later one.
            heads: the newest commits of main and of the branches.

        Raises:
            RemoteAway: if the remote cannot be reached. The next check handles the proposals that
                this check did not reach.
        """
        while self._changed:
            branch = self._changed.popleft()
            for proposal in self._proposals.values():
                if proposal.branch == branch:
                    proposal.checked_at = ""
        began, proposals = self._runtime.monotonic(), list(self._proposals.values())
        for number, proposal in enumerate(proposals):
            if number and self._must_pause(began):
                self._check_next(proposals[number:])
                break
            try:
                if not proposal.is_unchanged(str(snapshot.commit), heads.branches):
                    self._check(proposal, snapshot, heads)
            except BranchMoved as error:
                log.info("%s; checking again", error)
                self._changed.append(proposal.branch)
            except (SigningFailed, PushDenied) as error:
                # while the branch exists, a person can still merge it
                if proposal.tickets and proposal.branch in heads.branches:
                    self._runtime.failed(f"rebuilding {proposal.branch}", error)
                else:
                    self._end(proposal, error)
        self._timer.ended(str(snapshot.commit))

    def _must_pause(self, began: float) -> bool:
        is_long = self._runtime.monotonic() - began > _LONGEST_CHECK_S
        return is_long and self._demands.has_queued

    def _check_next(self, proposals: list[Proposal]) -> None:
        """Make another check due, which begins with ``proposals``."""
        first = set(proposals)
        self._proposals = {k: p for k, p in self._proposals.items() if p in first} | self._proposals
        self._changed.append(proposals[0].branch)

    def _check(self, proposal: Proposal, snapshot: Snapshot, heads: BranchHeads) -> None:
        objects, tip = self._repository.objects, str(snapshot.commit)
        on_main = commit_log.operations_since(objects, snapshot.commit, proposal.searched_to)
        head, added = heads.branches.get(proposal.branch, ""), set[ClaimKey]()
        if proposal.record.pushed and head not in proposal.record.commits:
            added = ledger_files.added_by_people(objects, proposal.searched_to, snapshot.commit)
        proposal.searched_to = tip
        read = CommitBatch(self._repository, snapshot).read
        pull_request = self._forge.pull_request(proposal.branch)
        verdict = proposal.verdict(snapshot.state, read, on_main, added, head, pull_request)
        booked = [
            (ticket, self._receipt(ticket, decision, snapshot, on_main.get(ticket.operation)))
            for ticket, decision in verdict.booked
        ]
        self._demands.answer(booked)
        proposal.drop(booked)
        if verdict.unapproved:
            if booked and not head:  # a person merged only some of the demands
                proposal.record = replace(proposal.record, pushed=False)
            if not self._leave_out(proposal, verdict, snapshot, head):
                self._changed.append(proposal.branch)
                return
            proposal.checked_at = tip
        elif not booked or head in proposal.record.commits:
            self._delete_branch(proposal, heads)
        # the branch no longer has these demands, so nobody can merge them
        self._demands.answer(verdict.failed)
        self._demands.requeue(verdict.free)
        if not verdict.unapproved:
            proposal.wait_for([])
            self._forget(proposal, close=not booked)

    def _receipt(
        self,
        ticket: Ticket,
        decision: Decision | InvalidInput,
        snapshot: Snapshot,
        recorded: RecordedOutcome | None,
    ) -> Receipt:
        commit = recorded.commit if recorded else str(snapshot.commit)
        # a person merged the demand, but a later commit changed its files
        if isinstance(decision, InvalidInput) or decision.files:
            return Receipt(ticket.operation, ticket.name, "booked", commit)
        before = snapshot.state
        targets = targets_of_decision(before, decision) if self._with_targets else ()
        return replace(receipt_of(ticket, decision, commit, targets), outcome="booked")

    # ---- the branch and its pull request ----

    def _leave_out(
        self, proposal: Proposal, verdict: Verdict, snapshot: Snapshot, head: str
    ) -> bool:
        """Update the branch so that it contains only the demands that still need approval.

        Returns:
            False if the proposal must be checked again. The proposal then keeps all its demands.
        """
        before, is_updated = proposal.tickets, False
        proposal.wait_for(verdict.unapproved)
        try:
            is_updated = self._update(proposal, verdict, snapshot, head)
        finally:
            if not is_updated:
                proposal.tickets = [ticket for ticket in before if ticket.state != "done"]
        return is_updated

    def _update(self, proposal: Proposal, verdict: Verdict, snapshot: Snapshot, head: str) -> bool:
        """Rebuild the branch if it is outdated, open its pull request and notify the requesters.

        A branch with commits by a person stays unchanged.

        Returns:
            False if a demand was withdrawn meanwhile and the proposal must be checked again.
        """
        if head and head not in proposal.record.commits:
            if not proposal.edited:
                log.info("%s has commits by a person and stays unchanged", proposal.branch)
            proposal.edited = True
        elif not self._bring_up_to_date(proposal, verdict, snapshot, head):
            return False
        forge = snapshot.state.config.repo_settings.proposals
        if forge.forge in ("github", "gitea"):
            message = self._branches.message(proposal.record.commits[-1])
            body = pull_request_body(message, proposal.reasons)
            self._forge.open(forge, proposal.branch, title_of(message), body)
            if not self._forge.was_queried(proposal.branch):
                return True  # the requester is notified once the link is known
        request = self._forge.pull_request(proposal.branch)
        link = request.link if request else proposal.record.link
        for ticket in proposal.tickets:
            ticket.notify("proposed", waiting_text(proposal.branch, link, proposal.reasons))
        return True

    def _bring_up_to_date(
        self, proposal: Proposal, verdict: Verdict, snapshot: Snapshot, head: str
    ) -> bool:
        """Rebuild the branch on main, with one commit for each demand, unless it is up to date.

        Return False if a demand was withdrawn; the branch is then not pushed.
        """
        commits = CommitBatch(self._repository, snapshot)
        steps, failed = decide_in_turn(verdict.unapproved, snapshot.state, commits.read)
        verdict.failed.extend(failed)
        proposal.drop(failed)
        old, tip = proposal.record, snapshot.commit
        files = {path: text for _, step in steps for path, text in step.files.items()}
        if head and self._branches.is_up_to_date(tip, head, old.base, files):
            return True
        now, branch = self._runtime.now(), proposal.branch
        for ticket, step in steps:
            if step.files:
                commits.commit(step, ticket.operation, ticket.received, now, branch)
        commit = commits.head.commit
        newest = (head, str(commit)) if head else (str(commit),)
        record = replace(old, commits=newest, base=str(tip))
        if not self._journal(proposal, record):
            return False
        forge, options = snapshot.state.config.repo_settings.proposals, []
        if forge.forge == "gitlab":
            message = self._branches.message(str(commit))
            options = push_options(message, proposal.reasons, forge.labels)
        link = self._branches.put(branch, commit, head, options)
        self._journal(proposal, replace(record, pushed=True, link=link or old.link))
        log.info("%s %s", branch, "was rebuilt" if head else "awaits approval")
        return True

    def _journal(self, proposal: Proposal, record: ProposalRecord) -> bool:
        """Journal ``record`` for each demand; return False if a demand was withdrawn."""
        proposal.record = record
        waiting = [self._demands.propose(ticket, record) for ticket in proposal.tickets]
        return all(waiting)

    def _delete_branch(self, proposal: Proposal, heads: BranchHeads) -> None:
        head = heads.branches.get(proposal.branch)
        if head:
            self._branches.remove(proposal.branch, head)

    # ---- the end ----

    def _end(self, proposal: Proposal, error: DemandOpsError) -> None:
        self._demands.fail(proposal.tickets, error)
        self._forget(proposal, close=True)

    def _forget(self, proposal: Proposal, *, close: bool) -> None:
        self._proposals = {k: p for k, p in self._proposals.items() if p is not proposal}
        self._forge.forget(proposal.branch, close=close)

    def _on_forge_update(self, branch: str) -> None:
        """Make a check of the branch due, because its pull request changed.

        The forge's thread calls this.
        """
        self._changed.append(branch)
        self._demands.wake()

    def suspend(self) -> None:
        """Answer the demands that await approval: each gets an error, but stays in the journal.

        The next start resumes these demands.
        """
        error = ShuttingDown("the demand awaits approval, and is resumed at the next start")
        for proposal in self._proposals.values():
            self._demands.fail(proposal.tickets, error, keep=True)
        self._proposals = {}
        self._forge.close()


def _release_request(ticket: Ticket, state: State) -> DemandRequest | None:
    """Return the request of a ticket that ends demands, or None.

    None if the ticket is withdrawn, or its request would be refused.
    """
    if ticket.state == "withdrawn" or not is_release(ticket.goal):
        return None
    return admit_or_none(state, ticket.goal)
