"""A proposal: demands that wait together on one branch for a person's approval.

What one is found by, which requests give it up, and how it is described to the person.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from demandops.decision import State, admit
from demandops.demand.approval_rule import subjects_of
from demandops.demand.claim import Subject
from demandops.demand.demand_request import DemandRequest, Operation
from demandops.errors import InvalidInput
from demandops.service.ticket import ProposalRecord, Ticket

Key = tuple[str, ...]

_NEWS = "awaiting approval: "


@dataclass(eq=False)
class Proposal:
    """Demands of one key; ``requests`` are what they ask, ``reasons`` what asks for approval.

    Main up to ``seen`` holds none of it, and with main at ``looked`` all was done about it.
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
        """The branch that is to be merged."""
        return self.record.branch

    def is_unchanged(self, tip: str, branches: Mapping[str, str]) -> bool:
        """Tell whether nothing happened to it since it was looked at, with main at ``tip``."""
        head = branches.get(self.branch)
        waits = all(ticket.state == "waiting" for ticket in self.tickets)
        return waits and self.checked_at == tip and head in self.record.commits[-1:]

    def requesters(self) -> set[str]:
        """Return in whose name it stands."""
        return {who for request in self.requests for who in request.requesters()}

    def subjects(self) -> set[Subject]:
        """Return what it asks for."""
        return {subject for request in self.requests for subject in subjects_of(request)}

    def is_released_by(self, request: DemandRequest) -> bool:
        """Tell whether a request gives up all of it, in the name of one of its requesters."""
        if key_of(request) not in map(key_of, self.requests) or not self.requesters() & set(
            request.requesters()
        ):
            return False
        whole = request.operation is Operation.RELEASE
        return whole or self.subjects() <= set(subjects_of(request))


def key_of(request: DemandRequest) -> Key:
    """Return what proposals are told apart by: the demand, or the request and its requesters."""
    if request.operation.is_reference:
        return ("request", request.id, *sorted(request.requesters()))
    return ("demand", request.demand)


def is_release(goal: object) -> bool:
    """Tell whether a goal, not parsed yet, gives something up."""
    given = goal if isinstance(goal, dict) else {}
    return bool(given.get("shutdown") or given.get("operation") == Operation.RELEASE.value)


def admit_or_none(state: State, goal: object) -> DemandRequest | None:
    """Return what a goal asks, or nothing where it is refused."""
    try:
        return admit(state, goal)
    except InvalidInput:
        return None


def waiting_text(branch: str, link: str, reasons: Iterable[str]) -> str:
    """Return what a requester is told while the demand waits."""
    where = f"{branch} {link}" if link else branch
    why = ", ".join(reasons)
    return f"{_NEWS}{where}" + (f" (asked for by {why})" if why else "")


def parse_waiting_text(text: str) -> dict[str, str]:
    """Return branch and link out of :func:`waiting_text`; no link where there is none."""
    branch, _, rest = text.removeprefix(_NEWS).partition(" ")
    link = rest.split(" ")[0] if rest.startswith("http") else ""
    return {"branch": branch, "link": link}


def pull_request_body(message: str, reasons: Iterable[str]) -> str:
    """Return a commit's message as the text of a merge request.

    Fenced, for it holds ids that anybody may choose: nothing in them links, mentions or renders.
    """
    longest = max((len(run) for run in re.findall(r"`+", message)), default=0)
    fence = "`" * max(3, longest + 1)
    why = ", ".join(reasons) or "an access policy"
    return (
        f"A demand that needs approval, asked for by {why}. Merging carries it out; closing it or "
        f"deleting the branch turns it down.\n\n{fence}text\n{message.rstrip()}\n{fence}\n"
    )


def push_option_description(message: str, reasons: Iterable[str]) -> str:
    """Return the same in one line, for push options hold no more."""
    why = next((line for line in message.splitlines() if line.startswith("Why: ")), "")
    fence = "`" * (max((len(run) for run in re.findall(r"`+", why)), default=0) + 1)
    asks = ", ".join(reasons) or "an access policy"
    return (
        f"A demand that needs approval, asked for by {asks}. {fence} {why} {fence} Merging carries "
        "it out; deleting the branch turns it down."
    )
