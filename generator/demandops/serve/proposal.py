"""A proposal: demands that wait together on one branch for a person's approval.

Nothing here writes to the state repo or the journal. This module decides the verdict on a proposal,
recognizes the requests that release a proposal, composes the texts that describe it, and keeps its
pull request in step.
"""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

from demandops.base.errors import DemandOpsError, Fault, InvalidInput, TurnedDown, Withdrawn
from demandops.base.quoting import harmless, one_line
from demandops.base.runtime import Runtime, Thread, log
from demandops.base.settings import MAIN_BRANCH
from demandops.decide.admission import permission
from demandops.decide.decision import Decision, admit, decide
from demandops.decide.state import FileReader, State
from demandops.model.config.config import Config
from demandops.model.config.repo_settings import Proposals
from demandops.model.demand.demand import Demand
from demandops.model.ledger.claim import ClaimKey
from demandops.repo.forge import Forge, ForgeError, PullRequest, forge_for
from demandops.repo.history import commit_message
from demandops.repo.history.commit_log import LogEntry
from demandops.serve.journal import ProposalRecord, Ticket

Decided: TypeAlias = list[tuple[Ticket, Decision]]
Failed: TypeAlias = list[tuple[Ticket, DemandOpsError]]

_PREFIX = "awaiting approval: "


@dataclass(slots=True)
class Verdict:
    # Main has the claims of these, with the decision that each would get on the current main.
    booked: list[tuple[Ticket, Decision | InvalidInput]] = field(default_factory=list)
    # These were withdrawn or turned down, or can no longer be booked.
    failed: Failed = field(default_factory=list)
    free: list[Ticket] = field(default_factory=list)  # these no longer need approval
    unapproved: Decided = field(default_factory=list)
    # Why these are turned down, if main does not have it yet: then it must be recorded first.
    unrecorded: str = ""


@dataclass(eq=False)
class Proposal:
    record: ProposalRecord
    tickets: list[Ticket] = field(default_factory=list)
    requests: list[Demand] = field(default_factory=list)
    reasons: tuple[str, ...] = ()  # why approval is needed
    searched_to: str = ""  # up to this commit, main was searched for merged demands
    checked_at: str = ""  # main at the last check; empty to check again
    edited: bool = False  # by a person who committed to the branch
    refused_from: float | None = None  # since when the server does not take the branch

    @property
    def branch(self) -> str:
        return self.record.branch

    @property
    def waits(self) -> bool:
        return any(ticket.state == "proposed" for ticket in self.tickets)

    def verdict(
        self,
        state: State,
        read: FileReader,
        on_main: Container[str],
        added: Container[ClaimKey],
        head: str,
        pull_request: PullRequest | None,
        rejection: LogEntry | None,
    ) -> Verdict:
        # ``on_main`` has the operation ids in the commits of main since ``searched_to``. ``added``
        # has the claims that people added since then, if a person edited or deleted the branch.
        # ``head`` is empty if the branch does not exist. ``rejection`` is the commit of main that
        # rejects the proposal.
        verdict = Verdict()
        for ticket in self.tickets:
            decision: Decision | InvalidInput
            try:
                decision = decide(state, ticket.demand, ticket.received, read)
            except InvalidInput as error:
                decision, is_merged = error, False
            else:
                # A squash merge may lose the trailer that names the operation. So a demand is
                # booked also if it would change no file of main, or only claims that people added.
                changes = decision.changes.claims
                is_merged = not decision.files or (
                    bool(changes) and all(change.key in added for change in changes)
                )
            if ticket.operation in on_main or is_merged:
                verdict.booked.append((ticket, decision))
            elif ticket.withdrawn:
                verdict.failed.append((ticket, Withdrawn(ticket.withdrawn)))
            elif isinstance(decision, InvalidInput):
                verdict.failed.append((ticket, decision))
            elif decision.approval:
                verdict.unapproved.append((ticket, decision))
            else:
                verdict.free.append(ticket)
        # a branch is gone after a merge too, but then its demands are booked
        if verdict.booked or not verdict.unapproved:
            return verdict
        if rejection is not None:
            by = "" if rejection.by_generator else f" by {rejection.author}"
            reason = f": {why}" if (why := rejection.first("Reason")) else ""
            why_not = TurnedDown(f"was turned down{by}{reason} (commit {rejection.commit[:10]})")
            verdict.failed.extend((ticket, why_not) for ticket, _ in verdict.unapproved)
            verdict.unapproved.clear()
        elif self.record.pushed and not head:
            verdict.unrecorded = f"{self.branch} was deleted and not merged"
        elif pull_request is not None and pull_request.state == "closed":
            verdict.unrecorded = f"{pull_request.link} was closed and not merged"
        return verdict

    def drop(self, answered: Iterable[tuple[Ticket, object]]) -> None:
        gone = [ticket for ticket, _ in answered]
        self.tickets = [ticket for ticket in self.tickets if ticket not in gone]

    def goals(self) -> list[str]:
        # as JSON, because in Python 1 equals true
        tickets = (ticket for ticket in self.tickets if ticket.state == "proposed")
        return [json.dumps(ticket.demand.goal) for ticket in tickets]

    def requesters(self) -> set[str]:
        return {name for request in self.requests for name in request.requesters()}


def releases(request: Demand, pending: Sequence[Demand], config: Config) -> bool:
    # has the key of one of the demands and may end it; names all their subjects or is a Release
    if key_of(request) not in map(key_of, pending):
        return False
    if proposed_stranger_faults(request, pending, config):
        return False
    subjects = {subject for other in pending for subject in other.listed_subjects()}
    return request.operation == "release" or subjects <= set(request.subjects())


def proposed_stranger_faults(
    request: Demand, pending: Iterable[Demand], config: Config
) -> list[Fault]:
    owners = {name for other in pending for name in other.requesters()}
    homes = [item.held.home for other in pending for item in other.demanded]
    return list(permission.stranger_faults(request, owners, homes, config))


def key_of(request: Demand) -> tuple[str, ...]:
    if request.is_reference:  # the reference's goals have no demand id
        return ("request", request.id, *sorted(request.requesters()))
    return ("demand", request.demand)


def decide_in_turn(left: Decided, state: State, read: FileReader) -> tuple[Decided, Failed]:
    written: dict[str, str | None] = {}
    steps, failed = Decided(), Failed()

    def read_step(path: str) -> str | None:
        return written[path] if path in written else read(path)

    for ticket, decision in left:
        # a lease counts from the approval on
        request = replace(decision.request, awaits_approval=True)
        try:
            step = decide(state, request, ticket.received, read_step)
        except InvalidInput as error:
            failed.append((ticket, error))
            continue
        state = step.state
        written.update(step.files)
        steps.append((ticket, step))
    return steps, failed


def admit_or_none(state: State, demand: Demand) -> Demand | None:
    try:
        return admit(state, demand)
    except InvalidInput:
        return None


# ---- the texts that describe a proposal ----


def waiting_text(branch: str, link: str, reasons: Iterable[str]) -> str:
    branch_and_link = f"{branch} {link}" if link else branch
    why = ", ".join(reasons)
    return one_line(f"{_PREFIX}{branch_and_link}" + (f" (required by {why})" if why else ""))


def parse_waiting_text(text: str) -> dict[str, str]:
    branch, _, link_and_why = text.removeprefix(_PREFIX).partition(" ")
    link = link_and_why.split(" ")[0] if link_and_why.startswith("http") else ""
    return {"branch": branch, "link": link}


def pull_request_texts(message: str) -> tuple[str, str]:
    # Requesters choose the ids in the message. Outside of a code block, an id could become a link.
    title, fence = message.partition("\n")[0], backticks(message, 3)
    return title, (
        f"{_head(message)} Merging approves the demand; closing this pull request or deleting the "
        f"branch rejects the demand.\n\n{fence}text\n{message.rstrip()}\n{fence}\n"
    )


def push_options(message: str, labels: Iterable[str]) -> list[str]:
    # GitLab opens a merge request for these; an option of git is one line
    title = message.partition("\n")[0]
    why = next((line for line in message.splitlines() if line.startswith("Why: ")), "")
    description = (
        f"{_head(message)} {code(why)} Merging approves the demand; deleting the branch rejects "
        "the demand."
    )
    labelled = (f"merge_request.label={label}" for label in labels)
    return [*merge_request(title, description), *labelled]


def merge_request(title: str, description: str) -> list[str]:
    return [
        "merge_request.create",
        f"merge_request.target={MAIN_BRANCH}",
        f"merge_request.title={title}",
        f"merge_request.description={description}",
        "merge_request.remove_source_branch",
    ]


def _head(message: str) -> str:
    trailers = commit_message.parse(message).trailers
    reasons = ", ".join(trailers.get(commit_message.REQUIRED_BY, ()))
    changed = "".join(
        f"This has changed: it replaces {old}, and no approval of that counts here. "
        for old in trailers.get(commit_message.REPLACES, ())
    )
    why = code(reasons) if reasons else "an access policy"
    return f"{changed}This demand needs approval, as required by {why}."


def code(text: str) -> str:
    """Return text from outside as code in one line of Markdown."""
    fence = backticks(text, 1)
    return f"{fence} {harmless(one_line(text))} {fence}"


def backticks(text: str, least: int) -> str:
    # more backticks than the text has in a row
    return "`" * max([least, *(len(run) + 1 for run in re.findall(r"`+", text))])


# ---- the pull requests, which a thread keeps in step with the proposals ----
#
# A slow or unreachable forge delays no demand and no proposal, because a branch can be merged
# without a pull request.

# The seconds between two queries to the forge, to learn which pull requests were closed.
POLL_S = 30.0
_REST_S = 60.0  # how long to pause after a forge has answered that it got too many requests


@dataclass(frozen=True, slots=True)
class _Task:
    forge: Proposals
    branch: str  # of a proposal, or the commit whose pull request gets a comment
    title: str
    body: str
    closed_as: str = ""  # why to close the pull request; empty to open it
    is_comment: bool = False


class ForgeWorker:
    # only the worker thread calls its public methods
    def __init__(
        self, token_file: Path | None, on_update: Callable[[str], None], runtime: Runtime
    ) -> None:
        self._token_file, self._on_update, self._runtime = token_file, on_update, runtime
        self._tasks: deque[_Task] = deque()
        self._due = runtime.event()
        self._wanted: dict[str, _Task] = {}
        self._pull_requests: dict[str, PullRequest | None] = {}
        self._lock = runtime.lock()
        self._thread: Thread | None = None
        self._last_error = ""
        self._closed = False

    def close(self) -> None:
        self._closed = True  # the thread still does its tasks; the pull requests stay
        self._due.set()

    def open(self, forge: Proposals, branch: str, title: str, body: str) -> None:
        if branch not in self._wanted:
            task = _Task(forge, branch, title, body)
            with self._lock:
                self._wanted[branch] = task
            self._enqueue(task)

    def comment(self, forge: Proposals, commit: str, text: str) -> None:
        self._enqueue(_Task(forge, commit, "", text, is_comment=True))

    def was_queried(self, branch: str) -> bool:
        # also true if the forge cannot be queried now
        return branch in self._pull_requests

    def pull_request(self, branch: str) -> PullRequest | None:
        return self._pull_requests.get(branch)

    def forget(self, branch: str, closed_as: str) -> None:
        with self._lock:
            task = self._wanted.pop(branch, None)
            pull_request = self._pull_requests.pop(branch, None)
        # closed by a person
        is_closed = pull_request is not None and pull_request.state == "closed"
        if task is not None and closed_as and not is_closed:
            self._enqueue(replace(task, closed_as=closed_as))

    def _enqueue(self, task: _Task) -> None:
        self._tasks.append(task)
        self._due.set()
        if self._thread is None:  # most state repos have no forge, and need no thread for it
            self._thread = self._runtime.keep_running("forge", self._run)

    # ---- in the forge's thread ----

    def _run(self) -> None:
        poll_at = self._runtime.monotonic() + POLL_S
        while not self._closed:
            self._due.wait(max(0.0, poll_at - self._runtime.monotonic()))
            self._due.clear()
            if self._runtime.monotonic() >= poll_at:
                poll_at = self._runtime.monotonic() + POLL_S
                with self._lock:
                    self._tasks.extend(self._wanted.values())
            while self._tasks:
                task = self._tasks.popleft()
                pull_request = self._pull_requests.get(task.branch)
                try:
                    if (forge := forge_for(task.forge, self._token_file)) is None:
                        continue
                    if task.is_comment:
                        forge.comment(task.branch, task.body)
                        continue
                    pull_request = self._handle(task, forge, pull_request)
                except ForgeError as error:
                    if str(error) != self._last_error:
                        log.warning("%s: %s", task.branch, error)
                    self._last_error = str(error)
                    if error.asks_to_wait or error.status is None:
                        # notify the requesters now, not only once the forge answers again
                        for waiting in (task, *self._tasks):
                            self._remember(waiting, self._pull_requests.get(waiting.branch))
                    if error.asks_to_wait:
                        self._tasks.appendleft(task)
                        self._runtime.sleep(_REST_S)
                        continue
                except Exception as error:  # one pull request must not stop the others
                    self._runtime.failed(f"forge of {task.branch}", error)
                self._remember(task, pull_request)

    @staticmethod
    def _handle(task: _Task, forge: Forge, known: PullRequest | None) -> PullRequest | None:
        if not task.closed_as and known is None:
            return forge.open(task.branch, MAIN_BRANCH, task.title, task.body)
        current = forge.find(task.branch, MAIN_BRANCH) or known
        if task.closed_as and current is not None and current.state != "merged":
            # the forge may have closed it already, because its branch is gone
            forge.close(current, f"Closed: {task.closed_as}\n\n{task.body}")
        return current

    def _remember(self, task: _Task, pull_request: PullRequest | None) -> None:
        with self._lock:
            # it may be forgotten during the query
            if task.is_comment or task.closed_as or task.branch not in self._wanted:
                return
            before = self._pull_requests.get(task.branch, "not queried")
            self._pull_requests[task.branch] = pull_request
        if before != pull_request:
            self._on_update(task.branch)
