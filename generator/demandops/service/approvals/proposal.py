"""A proposal: demands that wait together on one branch for a person's approval.

Nothing here writes to the state repo or the journal. This module decides the verdict on a proposal,
recognizes the requests that release a proposal, and composes the texts that describe it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from demandops.decision import Decision, State, admit, decide
from demandops.demand import permission
from demandops.demand.claim import ClaimKey
from demandops.demand.demand_request import DemandRequest, Release
from demandops.errors import DemandOpsError, InvalidInput, TurnedDown, Withdrawn
from demandops.forge import PullRequest
from demandops.quoting import harmless, one_line
from demandops.render.changes.changeset import FileReader
from demandops.service.ticket import Ticket
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.history import commit_log, message_format
from demandops.staterepo.write.journal import ProposalRecord

Decided: TypeAlias = list[tuple[Ticket, Decision]]
Failed: TypeAlias = list[tuple[Ticket, DemandOpsError]]

_PREFIX = "awaiting approval: "


@dataclass(frozen=True, slots=True)
class Verdict:
    """The demands of a proposal, grouped by what happens to them.

    ``booked``: main has the claims of these demands. ``failed``: these demands were withdrawn or
    turned down, or can no longer be booked; each has its error. ``free``: these demands no longer
    need approval. ``unapproved``: these demands still need approval. Booked and unapproved demands
    have the decision that they would get on the current main; a booked demand that would be refused
    there has the error.
    """

    booked: list[tuple[Ticket, Decision | InvalidInput]] = field(default_factory=list)
    failed: Failed = field(default_factory=list)
    free: list[Ticket] = field(default_factory=list)
    unapproved: Decided = field(default_factory=list)


@dataclass(eq=False)
class Proposal:
    """A demand that awaits approval on a branch, with all goals that ask for it.

    ``reasons`` say why approval is needed. ``searched_to`` is the commit of main up to which the
    history was searched for merged demands. ``checked_at`` is the commit of main at the last check;
    it is empty if the proposal must be checked again. ``edited`` is true if a person committed to
    the branch.
    """

    record: ProposalRecord
    tickets: list[Ticket] = field(default_factory=list)
    requests: list[DemandRequest] = field(default_factory=list)
    reasons: tuple[str, ...] = ()
    searched_to: str = ""
    checked_at: str = ""
    edited: bool = False

    @property
    def branch(self) -> str:
        """The name of the branch that a person merges."""
        return self.record.branch

    @property
    def waits(self) -> bool:
        """Whether a demand waits that was not withdrawn."""
        return any(ticket.state == "proposed" for ticket in self.tickets)

    def is_unchanged(self, tip: str, branches: Mapping[str, str]) -> bool:
        """Return whether main, this proposal's branch and its demands are as at the last check.

        ``tip`` is the newest commit of main. ``branches`` maps the name of each branch to its
        newest commit.
        """
        head = branches.get(self.branch)
        all_wait = all(ticket.state == "proposed" for ticket in self.tickets)
        return all_wait and self.checked_at == tip and head in self.record.commits[-1:]

    def verdict(
        self,
        state: State,
        read: FileReader,
        on_main: Container[str],
        added: Container[ClaimKey],
        head: str,
        pull_request: PullRequest | None,
    ) -> Verdict:
        """Return the verdict on the proposal's demands.

        A demand counts as booked if a commit of main names its operation id in a trailer. A squash
        merge may lose the trailer. So a demand also counts as booked if it would change no file of
        main, or if it would change only claims in ``added``.

        If no demand is booked, and the branch is gone or the pull request was closed, the demands
        that still need approval are turned down.

        Args:
            state: the state of main.
            read: reads a file of main.
            on_main: the operation ids in the commits of main since ``searched_to``.
            added: the claims that people have added to main since ``searched_to``; empty unless a
                person has edited or deleted the branch.
            head: the newest commit of the branch; empty if the branch does not exist.
            pull_request: the pull request, if it is known.
        """
        verdict = Verdict()
        for ticket in self.tickets:
            decision: Decision | InvalidInput
            try:
                decision = decide(state, ticket.goal, ticket.received, read)
            except InvalidInput as error:
                decision = error
            changes_main = isinstance(decision, InvalidInput) or (
                decision.files and not _changes_only(added, decision)
            )
            if ticket.operation in on_main or not changes_main:
                verdict.booked.append((ticket, decision))
            elif ticket.state == "withdrawn" and ticket.proposal:
                verdict.failed.append((ticket, Withdrawn(ticket.proposal.withdrawn)))
            elif isinstance(decision, InvalidInput):
                verdict.failed.append((ticket, decision))
            elif decision.approval:
                verdict.unapproved.append((ticket, decision))
            else:
                verdict.free.append(ticket)
        why_not = ""
        if self.record.pushed and not head:
            why_not = f"was turned down: {self.branch} is gone and was not merged"
        elif pull_request is not None and pull_request.state == "closed":
            why_not = f"was turned down: {pull_request.link} was closed"
        if why_not and not verdict.booked:
            verdict.failed.extend((ticket, TurnedDown(why_not)) for ticket, _ in verdict.unapproved)
            verdict.unapproved.clear()
        return verdict

    def drop(self, answered: Iterable[tuple[Ticket, object]]) -> None:
        """Remove the answered demands from the proposal."""
        gone = [ticket for ticket, _ in answered]
        self.tickets = [ticket for ticket in self.tickets if ticket not in gone]

    def wait_for(self, left: Decided) -> None:
        """Keep only the demands in ``left``, which still need approval."""
        self.tickets = [ticket for ticket, _ in left]
        self.requests = [decision.request for _, decision in left]
        self.reasons = tuple(dict.fromkeys(why for _, each in left for why in each.approval))

    def goals(self) -> list[str]:
        """Return the goals of the demands that were not withdrawn, as JSON: 1 is not true."""
        return [json.dumps(each.goal) for each in self.tickets if each.state == "proposed"]

    def requesters(self) -> set[str]:
        """Return the requesters of the proposal's demands."""
        return {name for request in self.requests for name in request.requesters()}


def _changes_only(claims: Container[ClaimKey], decision: Decision) -> bool:
    """Return whether a decision changes claims, and all that it changes are among ``claims``."""
    changes = decision.changes.claims
    return bool(changes) and all(change.key in claims for change in changes)


def releases(request: DemandRequest, pending: Sequence[DemandRequest]) -> bool:
    """Return whether a request releases all demands in ``pending``.

    It does if it has the key of one of these demands and a requester of one of them, and names all
    their subjects or is a :class:`Release`.
    """
    requesters = {name for each in pending for name in each.requesters()}
    if key_of(request) not in map(key_of, pending) or requesters.isdisjoint(request.requesters()):
        return False
    subjects = {subject for each in pending for subject in each.subjects()}
    return isinstance(request, Release) or subjects <= set(request.subjects())


def key_of(request: DemandRequest) -> tuple[str, ...]:
    """Return what tells a demand from others, whatever its content.

    That is the demand id. A request of the reference's action has none, so it is the request id and
    the requesters.
    """
    if request.is_reference:
        return ("request", request.id, *sorted(request.requesters()))
    return ("demand", request.demand)


def decide_in_turn(left: Decided, state: State, read: FileReader) -> tuple[Decided, Failed]:
    """Decide each demand on the state after the previous one, with leases that start at approval.

    Returns:
        The accepted demands with their new decisions, and the refused demands with their errors.
    """
    written: dict[str, str | None] = {}
    steps, failed = Decided(), Failed()
    for ticket, decision in left:
        request = permission.with_leases_from_approval(decision.request)
        try:
            step = decide(
                state,
                request,
                ticket.received,
                lambda path: written[path] if path in written else read(path),
            )
        except InvalidInput as error:
            failed.append((ticket, error))
            continue
        state = step.state
        written.update(step.files)
        steps.append((ticket, step))
    return steps, failed


def is_release(goal: object) -> bool:
    """Return whether a goal, as plain data, is a shutdown or the release of a demand."""
    fields = goal if isinstance(goal, dict) else {}
    return bool(fields.get("shutdown") or fields.get("operation") == Release.operation)


def admit_or_none(state: State, goal: object) -> DemandRequest | None:
    """Return the request of a goal, or None if the goal is refused."""
    try:
        return admit(state, goal)
    except InvalidInput:
        return None


def waiting_text(branch: str, link: str, reasons: Iterable[str]) -> str:
    """Return the text that a requester gets while the demand awaits approval."""
    branch_and_link = f"{branch} {link}" if link else branch
    why = ", ".join(reasons)
    return one_line(f"{_PREFIX}{branch_and_link}" + (f" (required by {why})" if why else ""))


def parse_waiting_text(text: str) -> dict[str, str]:
    """Return ``branch`` and ``link`` from a :func:`waiting_text`; the link may be empty."""
    branch, _, rest = text.removeprefix(_PREFIX).partition(" ")
    link = rest.split(" ")[0] if rest.startswith("http") else ""
    return {"branch": branch, "link": link}


def pull_request_texts(message: str) -> tuple[str, str]:
    """Return the title and the text of a pull request for a commit with this message.

    Requesters choose the ids in the message. Outside of a code block, an id could become a link.
    """
    title, fence = message.partition("\n")[0], _fence(message, 3)
    return title, (
        f"{_head(message)} Merging approves the demand; closing this pull request or deleting the "
        f"branch rejects the demand.\n\n{fence}text\n{message.rstrip()}\n{fence}\n"
    )


def push_options(message: str, labels: Iterable[str]) -> list[str]:
    """Return the push options that make GitLab open a merge request; each option is one line."""
    title = message.partition("\n")[0]
    why = next((line for line in message.splitlines() if line.startswith("Why: ")), "")
    description = (
        f"{_head(message)} {code(why)} Merging approves the demand; deleting the branch rejects "
        "the demand."
    )
    return [
        "merge_request.create",
        f"merge_request.target={MAIN_BRANCH}",
        f"merge_request.title={title}",
        f"merge_request.description={description}",
        "merge_request.remove_source_branch",
        *(f"merge_request.label={label}" for label in labels),
    ]


def _head(message: str) -> str:
    """Return why a pull request is there: what requires approval, and which one it replaces."""
    trailers = message_format.parse(message).trailers
    reasons = ", ".join(trailers.get(commit_log.REQUIRED_BY, ()))
    changed = "".join(
        f"This has changed: it replaces {old}, and no approval of that counts here. "
        for old in trailers.get(commit_log.REPLACES, ())
    )
    why = code(reasons) if reasons else "an access policy"
    return f"{changed}This demand needs approval, as required by {why}."


def code(text: str) -> str:
    """Return text from outside as code in one line of Markdown."""
    fence = _fence(text, 1)
    return f"{fence} {harmless(one_line(text))} {fence}"


def _fence(text: str, shortest: int) -> str:
    """Return at least ``shortest`` backticks, and more than ``text`` has in a row."""
    return "`" * max([shortest, *(len(run) + 1 for run in re.findall(r"`+", text))])
