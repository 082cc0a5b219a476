"""Keeping proposals: their branches and the requests to merge them, as main moves on.

Belongs to the thread that settles demands; knows how a proposal stands, not what is to become of
it (:mod:`demandops.service.approvals.approvals`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

from demandops.decision import Decision, decide
from demandops.demand import approval_rule
from demandops.errors import DemandOpsError, InvalidInput
from demandops.service.approvals.forge_worker import ForgeWorker
from demandops.service.approvals.proposal import Proposal, markdown, news, one_line
from demandops.service.demand_queue import DemandQueue
from demandops.service.ticket import Record, Ticket
from demandops.staterepo.git.repository import StateRepository
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write import commit_line
from demandops.staterepo.write.proposal_branch import Branches, Heads, gitlab_options

log = logging.getLogger("demandops")


class BranchSync:
    """Puts proposals where a person finds them, and takes them away again."""

    def __init__(
        self,
        repository: StateRepository,
        waiting: DemandQueue,
        token_file: Path | None,
        on_news: Callable[[str], None],
    ) -> None:
        self._repository = repository
        self._waiting = waiting
        self._branches = Branches(repository)
        self._desk = ForgeWorker(token_file, on_news)

    def heads(self) -> Heads:
        """Ask where the branches are.

        Raises:
            RemoteAway: where the remote does not answer.
        """
        return self._branches.heads()

    def turned_down(self, proposal: Proposal, heads: Heads) -> str:
        """Return how a person turned a proposal down that is not on main; empty where none did."""
        request = self._desk.request(proposal.branch)
        if proposal.record.pushed and proposal.branch not in heads.branches:
            return f"was turned down: {proposal.branch} is gone and was not merged"
        if request is not None and request.state == "closed":
            return f"was turned down: {request.link} was closed"
        return ""

    def take_away(self, proposal: Proposal, heads: Heads, *, if_unchanged: bool = False) -> None:
        """Delete the branch; ``if_unchanged``: not where somebody else has worked on it.

        Raises:
            BranchMoved, RemoteAway, PushDenied: where it could not be deleted.
        """
        head = heads.branches.get(proposal.branch)
        if head and (not if_unchanged or head in proposal.record.commits):
            self._branches.remove(proposal.branch, head)

    def forget(self, proposal: Proposal, *, close: bool) -> None:
        """Ask nobody any more; ``close`` the request where it is open."""
        self._desk.drop(proposal.branch, close=close)

    def keep_up(
        self,
        proposal: Proposal,
        left: list[tuple[Ticket, Decision]],
        snapshot: Snapshot,
        head: str,
    ) -> bool:
        """Put the branch where merging it gives what main would render now.

        Args:
            left: the demands that still need approval, and how each stands on main.
            head: where the branch is; empty where there is none yet.

        Returns:
            False where a demand was taken back meanwhile: look again.

        Raises:
            BranchMoved, RemoteAway, PushDenied: where the branch could not be put there.
        """
        proposal.reasons = tuple(dict.fromkeys(who for _, d in left for who in d.approval))
        proposal.requests = [decision.request for _, decision in left]
        record = proposal.record
        if head and head not in record.commits:
            self._tell_of_edits(proposal)
        else:
            steps, faulty = self._steps(left, snapshot)
            self._waiting.answer(faulty)
            dropped = [ticket for ticket, _ in faulty]
            proposal.tickets = [t for t in proposal.tickets if t not in dropped]
            if not steps:
                return False
            files = {path: text for _, d in steps for path, text in d.files.items()}
            made = self._branches.tree(snapshot.commit, files)
            stands = head and self._branches.is_fresh(snapshot.commit, head, record.base, made)
            if not stands and not self._lay(proposal, steps, snapshot, head):
                return False
        forge = snapshot.state.config.repo_settings.proposals
        message = self._branches.message(proposal.record.commits[-1])
        title, body = message.split("\n", 1)[0], markdown(message, proposal.reasons)
        if forge.forge in ("github", "gitea"):
            self._desk.want(forge, proposal.branch, title, body)
            if not self._desk.answered(proposal.branch):
                return True  # told together with the link
        self._tell(proposal)
        return True

    def _tell(self, proposal: Proposal) -> None:
        request = self._desk.request(proposal.branch)
        link = request.link if request else proposal.record.link
        text = news(proposal.branch, link, proposal.reasons)
        for ticket in proposal.tickets:
            ticket.tell("proposed", text)

    def _tell_of_edits(self, proposal: Proposal) -> None:
        if not proposal.edited:
            log.info("%s was changed by somebody else and is left to them", proposal.branch)
        proposal.edited = True

    def _steps(
        self, left: list[tuple[Ticket, Decision]], snapshot: Snapshot
    ) -> tuple[list[tuple[Ticket, Decision]], list[tuple[Ticket, DemandOpsError]]]:
        """Judge what is left one after the other, with leases that count from the approval."""
        line = commit_line.CommitLine(self._repository, snapshot)
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

    def _lay(
        self,
        proposal: Proposal,
        steps: list[tuple[Ticket, Decision]],
        snapshot: Snapshot,
        head: str,
    ) -> bool:
        """Commit the demands on main as it is and put the branch there; false where one goes."""
        line = commit_line.CommitLine(self._repository, snapshot)
        now = datetime.now(timezone.utc)
        for ticket, step in steps:
            if step.files:
                line.commit(step, ticket.operation, ticket.received, now, proposal.branch)
        made, old = str(line.head.commit), proposal.record
        record = replace(old, commits=(head, made) if head else (made,), base=str(snapshot.commit))
        if not self._keep(proposal, record):
            return False
        options = self._options(proposal, snapshot, made)
        link = self._branches.put(proposal.branch, line.head.commit, head, options)
        self._keep(proposal, replace(record, pushed=True, link=link or old.link))
        log.info("%s %s", proposal.branch, "is laid anew" if head else "awaits approval")
        return True

    def _options(self, proposal: Proposal, snapshot: Snapshot, made: str) -> list[str]:
        forge = snapshot.state.config.repo_settings.proposals
        if forge.forge != "gitlab":
            return []
        message = self._branches.message(made)
        title = message.split("\n", 1)[0]
        return gitlab_options(title, one_line(message, proposal.reasons), forge.labels)

    def _keep(self, proposal: Proposal, record: Record) -> bool:
        """Keep a record in the journal, for each demand; false where one was taken back."""
        proposal.record = record
        kept = [self._waiting.propose(ticket, record) for ticket in proposal.tickets]
        return all(kept)
