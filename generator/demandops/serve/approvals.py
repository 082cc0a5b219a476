"""The proposals that await approval, and the answers to their demands.

This code runs in the worker thread. A proposal is booked once main has its claims, whether by a
merge commit, a squash or a rebase. Until then the worker rebuilds the branch if a new main makes
it outdated. A branch to which a person has committed stays unchanged. :meth:`Proposal.verdict`
decides what happens to the demands of a proposal, and this module carries that verdict out.
"""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from demandops.base import errors
from demandops.base.errors import DemandOpsError, InvalidInput, Refused
from demandops.base.quoting import quoted
from demandops.base.runtime import log
from demandops.base.settings import PROPOSAL_LIMIT
from demandops.decide.decision import Decision
from demandops.decide.state import State
from demandops.model.demand.demand import Demand
from demandops.model.ledger.claim import ClaimKey
from demandops.repo.git.repository import PushDenied, StateRepository
from demandops.repo.git.signing import SigningFailed
from demandops.repo.history import commit_log, commit_message
from demandops.repo.history.commit_log import RecordedOutcome
from demandops.repo.load import ledger_files
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.snapshot import Snapshot
from demandops.repo.write.commit_batch import CommitBatch
from demandops.repo.write.proposal_branch import (
    BranchHeads,
    BranchMoved,
    ProposalBranches,
    branch_name,
)
from demandops.serve.demands import TAKEN_BACK, Demands
from demandops.serve.journal import ProposalRecord, Receipt, Ticket
from demandops.serve.proposal import (
    ForgeWorker,
    Proposal,
    Verdict,
    admit_or_none,
    code,
    decide_in_turn,
    key_of,
    proposed_stranger_faults,
    pull_request_texts,
    push_options,
    releases,
    waiting_text,
)

_MOST_TOLD = 20  # faults in the comment on a pull request

# How many seconds a check of all proposals may take before it pauses for a queued demand.
_LONGEST_CHECK_S = 0.5
# How long a branch is tried again that the server does not take, if it says nothing itself: then
# the connection may have failed.
_REFUSAL_PATIENCE_S = 120.0

RELEASED = "was released by a later request before it was approved"
REPLACED = "was replaced by a later demand of the same id before it was approved"

# A demand with its receipt, its error, or the decision that needs approval.
Result: TypeAlias = tuple[Ticket, Receipt | DemandOpsError | Decision]


class Approvals:
    def __init__(
        self,
        repository: StateRepository,
        state: State,
        demands: Demands,
        with_targets: bool,
        token_file: Path | None,
    ) -> None:
        self._repository, self._runtime = repository, repository.runtime
        self._demands = demands
        self.with_targets = with_targets
        self.branches = ProposalBranches(repository)

        def on_update(branch: str) -> None:
            self._changed.append(branch)  # in the forge's thread; a deque needs no lock for it
            demands.wake()

        self._forge = ForgeWorker(token_file, on_update, repository.runtime)
        self.proposals: dict[str, Proposal] = {}  # by branch
        self._changed: deque[str] = deque()
        self._unrecorded: list[tuple[Proposal, str]] = []  # rejected, and why
        for ticket in demands.proposed:  # of an earlier run
            request = admit_or_none(state, ticket.demand)
            record = replace(ticket.proposal or ProposalRecord(""), withdrawn="")
            new = Proposal(record, searched_to=ticket.base)
            proposal = self.proposals.setdefault(record.branch, new)
            if ticket.state == "proposed":  # a withdrawn ticket has an older record
                proposal.record = record
            proposal.tickets.append(ticket)
            proposal.requests += [request] if request else []
            self._changed.append(proposal.branch)
        for proposal in self.proposals.values():  # the last run may have ended in `add`
            if old := self.proposals.get(proposal.record.replaced_branch):
                self._replace(old, proposal.branch)

    # ---- while a batch is evaluated ----

    def remove_released(self, batch: Iterable[Ticket], state: State) -> None:
        # Before the batch is evaluated: once a branch is gone, nobody can merge it. If a person
        # merged it earlier, the batch is evaluated on a tip that includes the merge.
        for ticket in batch:
            if ticket.withdrawn or not ticket.demand.is_release:
                continue
            if (request := admit_or_none(state, ticket.demand)) is None:  # it would be refused
                continue
            for proposal in self.proposals.values():
                if not releases(request, proposal.requests, state.config):
                    continue
                self._demands.withdraw_proposed(proposal.tickets, RELEASED)
                if proposal.record.commits:
                    self._delete_branch(proposal.branch, self.branches.heads())
                # the next check answers the demands, because their branch may be merged already
                self._changed.append(proposal.branch)
                ticket.has_released = True

    def add(self, ticket: Ticket, decision: Decision) -> None:
        """Add a demand to the proposal of the same demand, or to a new one, or answer it."""
        try:
            self.refuse_strangers(decision)
        except Refused as refused:
            self._demands.fail([ticket], refused)
            return
        request, waiting = decision.request, self._waiting(decision.request)
        # What a person has seen on a branch never becomes another demand there. So a put with other
        # content gets a branch of its own, and replaces the earlier proposal.
        goal = json.dumps(ticket.demand.goal)
        proposal = next((old for old in waiting if goal in old.goals()), None)
        replaced = waiting if request.operation == "put" and proposal is None else []
        if proposal is None:
            open_proposals = [other for other in self.proposals.values() if other.waits]
            counts = Counter(name for other in open_proposals for name in other.requesters())
            names = request.requesters()
            full = next((name for name in names if counts[name] >= PROPOSAL_LIMIT), "")
            if full and not replaced:
                message = (
                    f"requester {quoted(full)} already has {PROPOSAL_LIMIT} proposals that await "
                    "approval; release some of the demands in these proposals, or ask a person to "
                    "approve or reject some of the proposals"
                )
                self._demands.fail([ticket], Refused.at("", message, code="quota"))
                return
            branch = branch_name(request.demand or request.id, ticket.operation)
            if branch in self.proposals:
                self._demands.fail([ticket], _belongs_to_another(branch))
                return
            replaces = ""
            if replaced:
                was = replaced[0].record
                # nobody has seen one without a commit, so the one that it replaces still counts
                replaces = f"{was.branch} {was.commits[-1]}" if was.commits else was.replaces
            proposal = Proposal(ProposalRecord(branch, replaces=replaces), searched_to=ticket.base)
        if not self._demands.propose(ticket, proposal.record):
            self._demands.fail([ticket], errors.Withdrawn(TAKEN_BACK))
            return
        self.proposals[proposal.branch] = proposal
        proposal.tickets.append(ticket)
        proposal.requests.append(request)
        self._changed.append(proposal.branch)
        for old in replaced:
            self._replace(old, branch)

    def _waiting(self, request: Demand) -> list[Proposal]:
        key = key_of(request)
        waiting = (proposal for proposal in self.proposals.values() if proposal.waits)
        return [proposal for proposal in waiting if key in map(key_of, proposal.requests)]

    def refuse_strangers(self, decision: Decision) -> None:
        # who may not change a demand that is proposed
        request = decision.request
        pending = [old for proposal in self._waiting(request) for old in proposal.requests]
        if faults := proposed_stranger_faults(request, pending, decision.state.config):
            raise Refused(faults)

    def withdraw_replaced(self, request: Demand) -> None:
        # by a put that needs no approval
        for proposal in self._waiting(request):
            self._demands.withdraw_proposed(proposal.tickets, REPLACED)

    def _replace(self, old: Proposal, branch: str) -> None:
        self._demands.withdraw_proposed(old.tickets, f"{REPLACED}: {branch}")
        self._changed.append(old.branch)  # the next check answers them: they may be merged already

    # ---- after main was read ----

    @property
    def has_news(self) -> bool:
        tickets = (ticket for proposal in self.proposals.values() for ticket in proposal.tickets)
        return bool(self._changed) or any(ticket.state == "withdrawn" for ticket in tickets)

    def check(
        self, snapshot: Snapshot, heads: BranchHeads, publish: Callable[[CommitBatch], bool]
    ) -> None:
        # It answers the demands that are decided or withdrawn, and updates the other proposals.
        # ``snapshot`` is of main, at ``heads.main`` or later. After an error, the next one goes on.
        while self._changed:
            if changed := self.proposals.get(self._changed.popleft()):
                changed.checked_at = ""
        began, proposals = self._runtime.monotonic(), list(self.proposals.values())
        for number, proposal in enumerate(proposals):
            is_long = self._runtime.monotonic() - began > _LONGEST_CHECK_S
            if number and is_long and self._demands.has_queued:
                # make another check due, which begins with the rest
                unchecked = {later.branch: later for later in proposals[number:]}
                self.proposals = unchecked | self.proposals
                self._changed.append(proposal.branch)
                break
            self._repository.while_waiting()
            try:
                is_unchanged = (
                    proposal.checked_at == str(snapshot.commit)
                    and all(ticket.state == "proposed" for ticket in proposal.tickets)
                    and heads.branches.get(proposal.branch) in proposal.record.commits[-1:]
                )
                if not is_unchanged:
                    self._check(proposal, snapshot, heads)
                    proposal.refused_from = None
            except BranchMoved as error:
                log.info("%s; checking again", error)
                self._changed.append(proposal.branch)
            except (SigningFailed, PushDenied) as error:
                if isinstance(error, PushDenied) and not error.is_verdict:
                    now = self._runtime.monotonic()
                    if proposal.refused_from is None:
                        proposal.refused_from = now
                        log.warning("%s; trying again for some time", error)
                    if now - proposal.refused_from < _REFUSAL_PATIENCE_S:
                        self._changed.append(proposal.branch)
                        continue
                # while the branch exists, a person can still merge it
                if proposal.tickets and proposal.branch in heads.branches:
                    self._runtime.failed(f"rebuilding {proposal.branch}", error)
                else:
                    self._demands.fail(proposal.tickets, error)
                    self._forget(proposal, str(error))

        self._record_rejections(snapshot, publish)

    def _record_rejections(
        self, snapshot: Snapshot, publish: Callable[[CommitBatch], bool]
    ) -> None:
        # A person who deletes a branch or closes a pull request leaves nothing in the history. So
        # the generator commits that, as `reject` does, and answers when the next check reads it.
        if not self._unrecorded:
            return
        commits, now = CommitBatch(self._repository, snapshot), self._runtime.now()
        while self._unrecorded:
            proposal, reason = self._unrecorded.pop()
            self._changed.append(proposal.branch)
            demands = dict.fromkeys(each.demand or each.id for each in proposal.requests)
            trailers = commit_message.rejection_trailers(
                proposal.branch,
                proposal.record.commits[-1],
                [each.demand for each in proposal.requests],
                sorted(proposal.requesters()),
                reason,
            )
            title = f"Reject {', '.join(demands)}: {reason}"
            commits.commit_without_files([[title]], trailers, now)
        if not publish(commits):
            log.info("another writer was first; recording the rejections again")

    def _check(self, proposal: Proposal, snapshot: Snapshot, heads: BranchHeads) -> None:
        objects, tip = self._repository.objects, str(snapshot.commit)
        rejections = commit_log.rejections_since(objects, tip, proposal.searched_to)
        on_main = commit_log.operations_since(objects, snapshot.commit, proposal.searched_to)
        head, added = heads.branches.get(proposal.branch, ""), set[ClaimKey]()
        if head and not proposal.record.commits:
            self._demands.fail(proposal.tickets, _belongs_to_another(proposal.branch))
            self.proposals.pop(proposal.branch, None)
            return
        # a person who edited or deleted the branch may have merged it without our operation ids
        if proposal.record.pushed and head not in proposal.record.commits:
            added = ledger_files.added_by_people(objects, proposal.searched_to, snapshot.commit)
        read = CommitBatch(self._repository, snapshot).read
        pull_request = self._forge.pull_request(proposal.branch)
        rejection = rejections.get(proposal.branch)
        verdict = proposal.verdict(
            snapshot.state, read, on_main, added, head, pull_request, rejection
        )
        if verdict.unrecorded:
            self._unrecorded.append((proposal, verdict.unrecorded))
            return
        tickets, commits, searched = proposal.tickets, proposal.record.commits, proposal.searched_to
        proposal.searched_to = tip
        booked = [
            (ticket, self._receipt(ticket, decision, snapshot, on_main.get(ticket.operation)))
            for ticket, decision in verdict.booked
        ]
        self._demands.answer(booked)
        proposal.drop(booked)
        if verdict.unapproved:
            if booked and not head:  # a person merged only some of the demands
                proposal.record = replace(proposal.record, pushed=False)
            # the branch is to contain only the demands that still need approval
            is_updated = False
            proposal.tickets = [ticket for ticket, _ in verdict.unapproved]
            proposal.requests = [decision.request for _, decision in verdict.unapproved]
            why = (reason for _, decision in verdict.unapproved for reason in decision.approval)
            proposal.reasons = tuple(dict.fromkeys(why))
            try:
                is_updated = self._update(proposal, verdict, snapshot, heads)
            finally:
                if not is_updated:  # the branch has them all still, and so has the next check
                    proposal.tickets = [ticket for ticket in tickets if ticket.state != "done"]
            if not is_updated:
                self._changed.append(proposal.branch)
                return
            proposal.checked_at = tip
        else:
            if proposal.record.commits and (not booked or head in proposal.record.commits):
                self._delete_branch(proposal.branch, heads)
            self._delete_replaced(proposal, heads)
        if (verdict.failed or verdict.free) and self._has_moved(proposal, commits, head, heads):
            proposal.tickets = [ticket for ticket in tickets if ticket.state != "done"]
            proposal.searched_to = searched
            self._changed.append(proposal.branch)
            return
        # the branch no longer has these demands, so nobody can merge them
        self._demands.answer(verdict.failed)
        self._demands.requeue(verdict.free)
        if not verdict.unapproved:
            cause = next((error for _, error in verdict.failed), "it needs no approval any more")
            self._forget(proposal, "" if booked else str(cause))

    @staticmethod
    def _has_moved(
        proposal: Proposal, commits: tuple[str, ...], head: str, heads: BranchHeads
    ) -> bool:
        # by this check: a person may have merged it just before, which only a later main shows
        there = heads.branches.get(proposal.branch, "")
        return (there, proposal.record.commits) != (head, commits)

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
            return Receipt(ticket.operation, ticket.demand.id, "booked", commit)
        before, operation = snapshot.state, ticket.operation
        receipt = Receipt.of(operation, decision, commit, before, self.with_targets)
        return replace(receipt, outcome="booked")

    # ---- the branch and its pull request ----

    def _update(
        self, proposal: Proposal, verdict: Verdict, snapshot: Snapshot, heads: BranchHeads
    ) -> bool:
        # false if a demand was withdrawn meanwhile, so that the proposal must be checked again
        if (head := heads.branches.get(proposal.branch)) and head not in proposal.record.commits:
            # a rebuild would throw away what a person has written
            if not proposal.edited:
                log.info("%s has commits by a person and stays unchanged", proposal.branch)
            proposal.edited = True
        elif not self._bring_up_to_date(proposal, verdict, snapshot, heads):
            return False
        forge = snapshot.state.config.repo_settings.proposals
        if forge.forge in ("github", "gitea"):
            message = self.branches.message(proposal.record.commits[-1])
            title, body = pull_request_texts(message)
            self._forge.open(forge, proposal.branch, title, body)
            if not self._forge.was_queried(proposal.branch):
                return True  # the requester is notified once the link is known
        request = self._forge.pull_request(proposal.branch)
        link = request.link if request else proposal.record.link
        for ticket in proposal.tickets:
            ticket.notify("proposed", waiting_text(proposal.branch, link, proposal.reasons))
        return True

    def _bring_up_to_date(
        self, proposal: Proposal, verdict: Verdict, snapshot: Snapshot, heads: BranchHeads
    ) -> bool:
        # one commit for each demand; false, without a push, if a demand was withdrawn
        commits = CommitBatch(self._repository, snapshot)
        steps, failed = decide_in_turn(verdict.unapproved, snapshot.state, commits.read)
        verdict.failed.extend(failed)
        proposal.drop(failed)
        old, tip = proposal.record, snapshot.commit
        head = heads.branches.get(old.branch, "")
        files = {path: text for _, step in steps for path, text in step.files.items()}
        if head and self.branches.is_up_to_date(tip, head, old.base, files):
            return True
        # If the demands would now book something else, such as another node that was chosen, the
        # proposal moves to another branch: what was approved so far is not that.
        if head and steps and not self.branches.books_the_same(tip, head, old.base, files):
            request, ticket = proposal.requests[0], proposal.tickets[0]
            branch = branch_name(request.demand or request.id, f"{ticket.operation} {head}")
            self._forget(proposal, f"main has changed, so it is proposed anew: {branch}")
            proposal.record = old = ProposalRecord(branch, replaces=f"{old.branch} {head}")
            self.proposals[branch] = proposal
            head = ""
        now, branch = self._runtime.now(), old.branch
        for ticket, step in steps:
            if step.files:
                more = [
                    (commit_message.PROPOSAL, old.branch),
                    (commit_message.REPLACES, old.replaces),
                    *((commit_message.REQUIRED_BY, reason) for reason in step.approval),
                ]
                commits.commit(step, ticket.operation, ticket.received, now, more)
        commit = commits.head.commit
        # Journal both commits before the push: after a crash either may be the branch's head, and
        # a head that is not known here would be taken for a person's.
        newest = (head, str(commit)) if head else (str(commit),)
        record = replace(old, commits=newest, base=str(tip))
        if not self._journal(proposal, record):
            return False
        if not head:
            self._delete_replaced(proposal, heads)
        forge, options = snapshot.state.config.repo_settings.proposals, []
        if forge.forge == "gitlab":
            message = self.branches.message(str(commit))
            options = push_options(message, forge.labels)
        link = self.branches.put(branch, commit, head, options)
        self._journal(proposal, replace(record, pushed=True, link=link or old.link))
        log.info("%s %s", branch, "was rebuilt" if head else "awaits approval")
        return True

    def _journal(self, proposal: Proposal, record: ProposalRecord) -> bool:
        # false if a demand was withdrawn
        proposal.record = record
        waiting = [self._demands.propose(ticket, record) for ticket in proposal.tickets]
        return all(waiting)

    def _delete_replaced(self, proposal: Proposal, heads: BranchHeads) -> None:
        # a replaced proposal that is still here deletes its branch itself, with its answers
        if proposal.record.replaced_branch not in self.proposals:
            self._delete_branch(proposal.record.replaced_branch, heads)

    def _delete_branch(self, branch: str, heads: BranchHeads) -> None:
        if head := heads.branches.get(branch):
            self.branches.remove(branch, head)
            del heads.branches[branch]

    def tell_of_faults(self, snapshot: Snapshot) -> None:
        """Comment on the pull requests whose merge made the configuration of main invalid."""
        forge, objects = snapshot.state.config.repo_settings.proposals, self._repository.objects
        if forge.forge not in ("github", "gitea"):
            return
        held = f"the configuration of commit {str(snapshot.configuration)[:10]} stays in effect"
        problems = snapshots.problems_of(objects, snapshot)[:_MOST_TOLD]
        text = (
            f"This is not in effect, because main is not valid; {held}, as a whole, until a commit "
            "is valid.\n\n"
            + "".join(f"- {code(str(problem))}\n" for problem in problems)
            + f"\nTo mend this, {snapshots.how_to_mend(objects, snapshot)}.\n"
        )
        for commit in snapshots.commits_to_revert(objects, snapshot):
            self._forge.comment(forge, commit, text)

    # ---- the end ----

    def _forget(self, proposal: Proposal, closed_as: str) -> None:
        self.proposals.pop(proposal.branch, None)
        self._forge.forget(proposal.branch, code(closed_as) if closed_as else "")

    def suspend(self) -> None:
        error = errors.ShuttingDown("the demand awaits approval, and is resumed at the next start")
        for proposal in self.proposals.values():
            self._demands.fail(proposal.tickets, error, keep=True)
        self.proposals = {}
        self._forge.close()


def _belongs_to_another(branch: str) -> InvalidInput:
    # a branch has the digest of an operation id in its name, and digests may collide
    message = (
        f"needs the branch {branch}, which belongs to another proposal; send the demand again with "
        "another operation id"
    )
    return Refused.at("", message, code="conflict")
