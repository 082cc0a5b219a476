"""A proposal: demands that wait together on one branch for a person's approval.

Its key, the requests that release it, and the texts that describe it to people.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from demandops.decision import State, admit
from demandops.demand.demand_request import DemandRequest, Release
from demandops.errors import InvalidInput
from demandops.service.ticket import ProposalRecord, Ticket
from demandops.subject import Subject

Key = tuple[str, ...]

_PREFIX = "awaiting approval: "


@dataclass(eq=False)
class Proposal:
    """Demands with one key.

    ``reasons`` is what asks for approval. No commit of main up to ``searched_to`` has a demand of
    it. ``checked_at`` is the commit of main at its last check. ``edited``: a person committed to
    the branch.
    """

    key: Key
    record: ProposalRecord
    tickets: list[Ticket] = field(default_factory=list)
    requests: list[DemandRequest] = field(default_factory=list)
    reasons: tuple[str, ...] = ()
    searched_to: str = ""
    checked_at: str = ""
    edited: bool = False

    @property
    def branch(self) -> str:
        """The branch to merge."""
        return self.record.branch

    def is_unchanged(self, tip: str, branches: Mapping[str, str]) -> bool:
        """Return whether nothing changed since the last check, with main at ``tip``."""
        head = branches.get(self.branch)
        all_wait = all(ticket.state == "proposed" for ticket in self.tickets)
        return all_wait and self.checked_at == tip and head in self.record.commits[-1:]

    def requesters(self) -> set[str]:
        """Return the requesters of its demands."""
        return {name for request in self.requests for name in request.requesters()}

    def subjects(self) -> set[Subject]:
        """Return the applications and connections that it requests."""
        return {subject for request in self.requests for subject in request.subjects()}

    def is_released_by(self, request: DemandRequest) -> bool:
        """Return whether a request by one of its requesters releases all of it."""
        if key_of(request) not in map(key_of, self.requests) or not self.requesters() & set(
            request.requesters()
        ):
            return False
        whole = isinstance(request, Release)
        return whole or self.subjects() <= set(request.subjects())


def key_of(request: DemandRequest) -> Key:
    """Return the key of a request's proposal: the demand, or the request and its requesters."""
    if request.is_reference:
        return ("request", request.id, *sorted(request.requesters()))
    return ("demand", request.demand)


def is_release(goal: object) -> bool:
    """Return whether a goal that is not parsed yet is a release."""
    fields = goal if isinstance(goal, dict) else {}
    return bool(fields.get("shutdown") or fields.get("operation") == Release.operation)


def admit_or_none(state: State, goal: object) -> DemandRequest | None:
    """Return the request of a goal, or None if it is refused."""
    try:
        return admit(state, goal)
    except InvalidInput:
        return None


def waiting_text(branch: str, link: str, reasons: Iterable[str]) -> str:
    """Return the feedback for a requester while the demand awaits approval."""
    branch_and_link = f"{branch} {link}" if link else branch
    why = ", ".join(reasons)
    return f"{_PREFIX}{branch_and_link}" + (f" (asked for by {why})" if why else "")


def parse_waiting_text(text: str) -> dict[str, str]:
    """Return branch and link from a :func:`waiting_text`; the link may be empty."""
    branch, _, rest = text.removeprefix(_PREFIX).partition(" ")
    link = rest.split(" ")[0] if rest.startswith("http") else ""
    return {"branch": branch, "link": link}


def pull_request_body(message: str, reasons: Iterable[str]) -> str:
    """Return the text of a pull request with a commit's message.

    The message is fenced, because it has ids that anyone may choose: none must become a link.
    """
    longest = max((len(run) for run in re.findall(r"`+", message)), default=0)
    fence = "`" * max(3, longest + 1)
    why = ", ".join(reasons) or "an access policy"
    return (
        f"A demand that needs approval, asked for by {why}. Merging carries it out; closing it or "
        f"deleting the branch turns it down.\n\n{fence}text\n{message.rstrip()}\n{fence}\n"
    )


def push_option_description(message: str, reasons: Iterable[str]) -> str:
    """Return the text of a merge request on one line, because a push option has only one."""
    why = next((line for line in message.splitlines() if line.startswith("Why: ")), "")
    fence = "`" * (max((len(run) for run in re.findall(r"`+", why)), default=0) + 1)
    asks = ", ".join(reasons) or "an access policy"
    return (
        f"A demand that needs approval, asked for by {asks}. {fence} {why} {fence} Merging carries "
        "it out; deleting the branch turns it down."
    )
