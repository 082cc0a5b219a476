"""Keeps the branches and pull requests of proposals up to date while main moves on.

Belongs to the worker thread. :mod:`demandops.service.approvals.approvals`
decides how a proposal ends.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from demandops.decision import Decision, decide
from demandops.demand import approval_rule
from demandops.errors import DemandOpsError, InvalidInput
from demandops.service.approvals.forge_worker import ForgeWorker
from demandops.service.approvals.proposal import (
    Proposal,
    pull_request_body,
    push_option_description,
    waiting_text,
)
from demandops.service.demand_queue import DemandQueue
from demandops.service.ticket import ProposalRecord, Ticket
from demandops.staterepo.git.repository import StateRepository
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write import commit_batch
from demandops.staterepo.write.proposal_branch import BranchHeads, ProposalBranches, gitlab_options

log = logging.getLogger("demandops")


class BranchSync:
    """Creates, updates and deletes the branches of proposals."""

    def __init__(
        self,
        repository: StateRepository,
        queue: DemandQueue,
        token_file: Path | None,
        on_update: Callable[[str], None],
    ) -> None:
        self._repository = repository
        self._queue = queue
        self._branches = ProposalBranches(repository)
        self._forge = ForgeWorker(token_file, on_update, repository.runtime)

    def fetch_heads(self) -> BranchHeads:
        """Fetch the commits of main and of the branches.

        Raises:
            RemoteAway: if the remote cannot be reached.
        """
        return self._branches.heads()

    def turned_down_because(self, proposal: Proposal, heads: BranchHeads) -> str:
        """Return how a person turned a proposal down that is not on main, or empty."""
        request = self._forge.pull_request(proposal.branch)
        if proposal.record.pushed and proposal.branch not in heads.branches:
            return f"was turned down: {proposal.branch} is gone and was not merged"
        if request is not None and request.state == "closed":
            return f"was turned down: {request.link} was closed"
        return ""

    def delete(self, proposal: Proposal, heads: BranchHeads, *, if_unchanged: bool = False) -> None:
        """Delete the branch; ``if_unchanged``: unless a person committed to it.

        Raises:
            BranchMoved, RemoteAway, PushDenied: if it could not be deleted.
        """
        head = heads.branches.get(proposal.branch)
        if head and (not if_unchanged or head in proposal.record.commits):
            self._branches.remove(proposal.branch, head)

    def forget(self, proposal: Proposal, *, close: bool) -> None:
        """Stop watching the pull request; ``close``: also close it if it is open."""
        self._forge.forget(proposal.branch, close=close)

    def update(
        self,
        proposal: Proposal,
        left: list[tuple[Ticket, Decision]],
        snapshot: Snapshot,
        head: str,
    ) -> bool:
        """Update the branch, so that merging it gives what main would render now.

        Args:
            left: the demands that still need approval, each with its decision on main.
            head: the commit of the branch; empty if there is no branch yet.

        Returns:
            False if a demand was withdrawn meanwhile and the proposal must be checked again.

        Raises:
            BranchMoved, RemoteAway, PushDenied: if the branch could not be pushed.
        """
        proposal.reasons = tuple(dict.fromkeys(reason for _, d in left for reason in d.approval))
        proposal.requests = [decision.request for _, decision in left]
        record = proposal.record
        if head and head not in record.commits:
            self._mark_edited(proposal)
        else:
            steps, faulty = self._decide(left, snapshot)
            self._queue.answer(faulty)
            dropped = [ticket for ticket, _ in faulty]
            proposal.tickets = [t for t in proposal.tickets if t not in dropped]
            if not steps:
                return False
            files = {path: text for _, d in steps for path, text in d.files.items()}
            tree = self._branches.tree(snapshot.commit, files)
            is_fresh = head and self._branches.is_up_to_date(
                snapshot.commit, head, record.base, tree
            )
            if not is_fresh and not self._commit_and_push(proposal, steps, snapshot, head):
                return False
        forge = snapshot.state.config.repo_settings.proposals
        message = self._branches.message(proposal.record.commits[-1])
        title, body = message.split("\n", 1)[0], pull_request_body(message, proposal.reasons)
        if forge.forge in ("github", "gitea"):
            self._forge.open(forge, proposal.branch, title, body)
            if not self._forge.has_answered(proposal.branch):
                return True  # the requester is notified once the link is known
        self._notify(proposal)
        return True

    def _notify(self, proposal: Proposal) -> None:
        request = self._forge.pull_request(proposal.branch)
        link = request.link if request else proposal.record.link
        text = waiting_text(proposal.branch, link, proposal.reasons)
        for ticket in proposal.tickets:
            ticket.notify("proposed", text)

    def _mark_edited(self, proposal: Proposal) -> None:
        if not proposal.edited:
            log.info("%s has commits by a person and stays unchanged", proposal.branch)
        proposal.edited = True

    def _decide(
        self, left: list[tuple[Ticket, Decision]], snapshot: Snapshot
    ) -> tuple[list[tuple[Ticket, Decision]], list[tuple[Ticket, DemandOpsError]]]:
        """Decide the demands one after the other, with leases that start at the approval."""
        line = commit_batch.CommitBatch(self._repository, snapshot)
        state, written = snapshot.state, dict[str, str | None]()
        steps, faulty = list[tuple[Ticket, Decision]](), list[tuple[Ticket, DemandOpsError]]()

        def read(path: str) -> str | None:
            return written[path] if path in written else line.read(path)

        for ticket, decision in left:
            try:
                step = decide(
                    state,
                    approval_rule.with_leases_from_approval(decision.request),
                    ticket.received,
                    read,
                )
            except InvalidInput as error:
                faulty.append((ticket, error))
                continue
            state = step.state
            written.update(step.files)
            steps.append((ticket, step))
        return steps, faulty

    def _commit_and_push(
        self,
        proposal: Proposal,
        steps: list[tuple[Ticket, Decision]],
        snapshot: Snapshot,
        head: str,
    ) -> bool:
        """Commit the demands on main and push the branch; return False if one was withdrawn."""
        line = commit_batch.CommitBatch(self._repository, snapshot)
        now = self._repository.runtime.now()
        for ticket, step in steps:
            if step.files:
                line.commit(step, ticket.operation, ticket.received, now, proposal.branch)
        commit, old = str(line.head.commit), proposal.record
        record = replace(
            old, commits=(head, commit) if head else (commit,), base=str(snapshot.commit)
        )
        if not self._journal(proposal, record):
            return False
        options = self._options(proposal, snapshot, commit)
        link = self._branches.put(proposal.branch, line.head.commit, head, options)
        self._journal(proposal, replace(record, pushed=True, link=link or old.link))
        log.info("%s %s", proposal.branch, "was rebuilt" if head else "awaits approval")
        return True

    def _options(self, proposal: Proposal, snapshot: Snapshot, commit: str) -> list[str]:
        forge = snapshot.state.config.repo_settings.proposals
        if forge.forge != "gitlab":
            return []
        message = self._branches.message(commit)
        title = message.split("\n", 1)[0]
        return gitlab_options(
            title, push_option_description(message, proposal.reasons), forge.labels
        )

    def _journal(self, proposal: Proposal, record: ProposalRecord) -> bool:
        """Journal a record for each demand; return False if one was withdrawn."""
        proposal.record = record
        waiting = [self._queue.set_proposal(ticket, record) for ticket in proposal.tickets]
        return all(waiting)
