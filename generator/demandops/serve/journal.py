"""Demands under way: the ticket of each, and the journal that keeps the tickets."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from demandops.base.errors import DemandOpsError, Refused, StateRepoError, Unsound
from demandops.base.quoting import quoted
from demandops.base.runtime import log
from demandops.cluster.health import Target
from demandops.cluster.rollouts import targets_of_decision
from demandops.decide.decision import Decision, Outcome
from demandops.decide.state import State, effects_of
from demandops.model.demand.demand import UNSTARTED, Demand
from demandops.model.demand.goals import read_journaled
from demandops.model.ledger.ledger import ClaimChange
from demandops.repo.git.objects import sync_folder
from demandops.repo.git.remote_repository import lock
from demandops.repo.git.repository import disk_error

# ---- a demand under way, from its submission to its receipt ----

# What a demand's listener is told.
Stage = Literal[
    "away",  # the state repo cannot be reached or written now
    "admitted",  # the demand is valid
    "booked",  # its claims are computed, but not committed yet
    "waiting",  # no node has room for it, so it will be booked later
    "committed",  # it has a commit
    "proposed",  # it awaits a person's approval
    "pushed",  # the commit in its receipt is published
    # Its answer is an error. Not told if the demand was not accepted, was taken back by its client,
    # or stays in the journal.
    "refused",
]
Listener = Callable[[Stage, str], None]

# Only :class:`demands.Demands` changes the state of a demand.
TicketState = Literal["arrived", "queued", "committed", "proposed", "withdrawn", "done"]


@dataclass(frozen=True, slots=True)
class Receipt:
    # of a demand whose commit is published and durable; if an earlier attempt or run published it,
    # only the first four fields are known
    operation: str
    request_id: str
    outcome: Outcome
    commit: str  # of a demand that changed nothing, the newest one on which it was decided
    warnings: tuple[str, ...] = ()
    not_held: tuple[str, ...] = ()
    placed: tuple[str, ...] = ()  # which nodes the generator chose, and why
    effects: tuple[str, ...] = ()  # what becomes of which releases
    lease_s: int | None = None
    targets: tuple[Target, ...] = ()  # the releases to follow, if the generator was asked for them
    changes: tuple[ClaimChange, ...] = ()

    @classmethod
    def of(
        cls, operation: str, decision: Decision, commit: str, before: State, with_targets: bool
    ) -> Receipt:
        return cls(
            operation,
            decision.request.id,
            decision.outcome,
            commit,
            warnings=decision.warnings,
            not_held=decision.changes.not_held,
            placed=decision.placed,
            effects=(*effects_of(decision.releases),),
            lease_s=decision.lease_s,
            targets=targets_of_decision(before, decision) if with_targets else (),
            changes=decision.changes.claims,
        )


@dataclass(frozen=True, slots=True)
class ProposalRecord:
    # what a restarted process needs to continue a proposal

    branch: str
    # where the generator left the branch, newest last; two if the newest's push may have failed
    commits: tuple[str, ...] = ()
    base: str = ""  # the commit of main on which the newest of the commits was made
    # If a pushed branch is missing, somebody deleted it. After a person merges only some of the
    # demands, this is false until the branch is pushed again.
    pushed: bool = False
    link: str = ""  # the address of the branch's merge request, if GitLab printed it at a push
    withdrawn: str = ""  # the reason why the demand was withdrawn
    replaces: str = ""  # branch and commit where the demand waited, before it became another

    @property
    def replaced_branch(self) -> str:
        return self.replaces.partition(" ")[0]


@dataclass(eq=False)
class Ticket:
    operation: str
    demand: Demand
    received: datetime
    # A tip that does not include the demand; only later commits may record the demand.
    base: str = ""
    proposal: ProposalRecord | None = None  # the journal keeps the fields up to this one
    listener: Listener = lambda stage, text: None
    future: Future[Receipt] = field(default_factory=Future)
    # True once a crash cannot lose the demand; false if it was refused without being journaled.
    journaled: Future[bool] = field(default_factory=Future)
    # Whether the remote may have accepted a push of the demand although no answer arrived.
    maybe_published: bool = False
    # Whether this demand released one that awaited approval: then it succeeds even if it ends no
    # claim.
    has_released: bool = False
    state: TicketState = "queued"
    # while it is in the queue: its place in the order of arrival, and what it touches (None: any)
    number: int = 0
    subjects: frozenset[Hashable] | None = None
    notified: set[str] = field(default_factory=set)
    unread: Refused | None = None  # why its goal in the journal cannot be read
    withdrawn: str = ""  # the reason, if it is

    def __post_init__(self) -> None:
        for future in (self.future, self.journaled):
            future.set_running_or_notify_cancel()  # a demand is withdrawn, not canceled

    @property
    def requester(self) -> str:  # the first; empty if there is none
        return next(iter(self.demand.requesters()), "")

    def refuse(self, error: DemandOpsError) -> None:
        # only a demand that is not in the journal yet
        self.state = "done"
        self.future.set_exception(error)
        self.journaled.set_result(False)

    def notify(self, stage: Stage, text: str) -> None:
        # A stage is reported once, although a demand is evaluated again after each lost race. But a
        # proposal has another text once its pull request is known.
        key = text if stage == "proposed" else stage
        if key in self.notified:
            return
        self.notified.add(key)
        try:
            self.listener(stage, text)
        except Exception:
            log.exception("a listener failed")

    def mark_maybe_published(self, base: str) -> None:
        if not self.maybe_published:  # the oldest base counts, because any try may have succeeded
            self.base, self.maybe_published = base, True

    def as_data(self) -> dict[str, Any]:
        # for the journal
        data = {
            "operation": self.operation,
            "goal": self.demand.goal,
            "received": self.received.isoformat(),
            "base": self.base,
        }
        return data | ({"proposal": asdict(self.proposal)} if self.proposal else {})

    @classmethod
    def from_data(cls, data: Any) -> Ticket:  # noqa: ANN401 - raises an error of many kinds
        proposal = data.pop("proposal", None)
        if data.keys() != {"operation", "goal", "received", "base"}:
            raise ValueError("a key is missing or unknown")
        received, unread = datetime.fromisoformat(data["received"]), None
        if not isinstance(data["operation"], str) or not isinstance(data["base"], str):
            raise ValueError("an id is no text")
        if received.tzinfo is None or not 1970 <= received.year < UNSTARTED.year:
            raise ValueError("the time has no zone, or a year that no generator writes")
        try:
            demand = read_journaled(data["goal"])
        except Refused as error:  # by a version that accepted it
            demand, unread = Demand("put", goal=data["goal"]), error
        # the earlier run may have ended after the push, so nobody can take the demand back
        ticket = cls(data["operation"], demand, received, data["base"], state="committed")
        ticket.maybe_published, ticket.unread = True, unread
        ticket.listener = ticket.tell_the_log
        ticket.journaled.set_result(True)
        if proposal is not None:
            commits = tuple(proposal["commits"])
            ticket.proposal = ProposalRecord(**{**proposal, "commits": commits})
            ticket.withdrawn = ticket.proposal.withdrawn
            ticket.state = "withdrawn" if ticket.withdrawn else "proposed"
        return ticket

    def tell_the_log(self, stage: Stage, text: str) -> None:
        name = f"demand {self.operation} ({quoted(self.demand.id)}) from the journal"
        if stage in ("proposed", "pushed"):
            log.info("%s: %s", name, text)
        elif stage == "refused":
            log.warning("%s: refused: %s", name, text)


# ---- the journal: all accepted, unpublished demands, so that a crash loses none ----
#
# The journal has one JSON line for each demand received, for each change of its proposal, and for
# each demand done. A demand is written and fsynced before it is evaluated. After a restart, demands
# that are not done are evaluated again. Their operation ids show which of them already have a
# published commit.
#
# The last key of a line is a digest of the line and of the previous line's digest. So a reader
# detects a changed, missing or moved line, but not that whole lines at the end are missing
# (docs/decisions/0020-journal.md). Journals of the first version have no digests, and can still be
# read.

_MOST_BYTES = 1 << 20
_SEALED = re.compile(rb'(\{.*), "digest": "([0-9a-f]{64})"\}')


class DamagedJournal(StateRepoError):
    """Raised if a journal has a changed entry, or an entry is missing."""

    def __init__(self, path: Path, line: int) -> None:
        super().__init__(
            f"{path}: line {line} is not what the generator wrote there; run `demandops journal "
            "--set-aside` for this state repo to move the file away and list its demands, "
            "then send again what is still needed"
        )


class Journal:
    """The journal of one process. It is not thread-safe: the caller must hold a lock."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._unsound: Unsound | None = None
        self.pending = read(path)
        self._chain, self._size, self._limit, self._is_broken = "", 0, 0, True
        try:
            self._file = path.open("ab", buffering=0)
            self._rewrite()
        except OSError as error:
            raise self._unwritten(error, "try again") from None

    def drop_requests(self) -> list[Path]:
        with suppress(OSError):  # the next look tries again
            return sorted(self._path.parent.glob(f"{_DROP}*"))
        return []

    def require_sound(self) -> None:
        if self._unsound is not None:
            raise self._unsound

    def append(self, tickets: Iterable[Ticket]) -> None:
        """Write and fsync all ``tickets``, or raise StateRepoError and write none of them.

        Unsound is raised if nobody knows whether they are written.
        """
        if tickets := list(tickets):
            self._write([ticket.as_data() for ticket in tickets], durably=True)
            self.pending.update((ticket.operation, ticket) for ticket in tickets)

    def mark_done(self, operations: Iterable[str], *, durably: bool = False) -> None:
        # With ``durably``, the removal is fsynced, and a failure raises StateRepoError and keeps
        # the demands. Otherwise the next append makes the removal durable. If the machine fails
        # before that, the demands are evaluated again after a restart. This is harmless if a commit
        # records their outcome, but a refused demand could be booked.
        done = [operation for operation in dict.fromkeys(operations) if operation in self.pending]
        records = [{"done": operation} for operation in done]
        if durably and done:
            self._write(records, durably=True)
        for operation in done:
            del self.pending[operation]
        if done and not durably:
            with suppress(StateRepoError):
                self._write(records, durably=False)

    def close(self) -> None:
        # if this fails, the next process may evaluate again a demand that is done
        with suppress(StateRepoError, Unsound):
            self._write([], durably=True)
        self._file.close()

    def _write(self, records: list[dict[str, Any]], *, durably: bool) -> None:
        self.require_sound()
        if self._size > self._limit:
            with suppress(OSError):  # the next write tries again
                self._rewrite()
        try:
            if self._is_broken:
                self._rewrite()
        except OSError as error:
            raise self._unwritten(error) from None
        text, chain = _sealed(records, self._chain)
        self._is_broken = True
        try:
            left = memoryview(text)
            while left:  # the system may write only a part
                left = left[os.write(self._file.fileno(), left) :]
            if durably:
                os.fdatasync(self._file.fileno())
        except OSError as error:
            unwritten = self._unwritten(error)
            try:
                self._file.truncate(self._size)
            except OSError:  # a restart could read demands that this process refuses
                self._unsound = Unsound(
                    f"the journal {self._path} cannot be written or truncated: {error.strerror}; "
                    "check its disk, then start again"
                )
                self.require_sound()
            raise unwritten from None
        self._is_broken, self._chain, self._size = False, chain, self._size + len(text)

    def _rewrite(self) -> None:
        text, chain = _sealed([ticket.as_data() for ticket in self.pending.values()], "")
        if text:
            fresh = self._path.with_suffix(".new")
            with fresh.open("wb") as writing:
                writing.write(text)
                writing.flush()
                os.fsync(writing.fileno())
            file = fresh.open("ab", buffering=0)
            self._is_broken = True
            fresh.replace(self._path)
            self._file.close()
            self._file = file
        else:
            self._is_broken = True
            self._file.truncate(0)  # a new file would need room, and the disk may be full
            os.fdatasync(self._file.fileno())
        sync_folder(self._path.parent)
        self._is_broken, self._chain, self._size = False, chain, len(text)
        # so that rewriting costs no more than what was appended
        self._limit = max(_MOST_BYTES, 2 * len(text))

    def _unwritten(self, error: OSError, remedy: str = "send the demand again") -> StateRepoError:
        reason = disk_error(error, f"the journal {self._path}")
        if isinstance(reason, Unsound):  # nobody knows what is on the disk
            self._unsound = reason
            raise reason from None
        return StateRepoError(
            f"the journal {self._path} cannot be written: {error.strerror or error}; check its "
            f"disk, then {remedy}"
        )


def read(path: Path) -> dict[str, Ticket]:
    return parse(path.read_bytes() if path.exists() else b"", path)


def parse(text: bytes, path: Path) -> dict[str, Ticket]:
    *lines, last = text.split(b"\n")
    chain = "" if _SEALED.fullmatch((lines or [last])[0]) else None
    pending: dict[str, Ticket] = {}
    for number, line in enumerate(lines, start=1):
        try:
            chain = _apply(line, chain, pending)
        except ValueError:
            raise DamagedJournal(path, number) from None
    with suppress(ValueError):
        _apply(last[:-1], chain, {})
        raise DamagedJournal(path, len(lines) + 1)  # only the line break of this line was changed
    # a crash has cut off an invalid last line, so its demand was never acknowledged
    with suppress(ValueError):
        _apply(last, chain, pending)
    return pending


def _sealed(records: Iterable[dict[str, Any]], chain: str) -> tuple[bytes, str]:
    # the lines after one with the digest ``chain``, and the last digest
    lines = []
    for record in records:
        body = json.dumps(record, ensure_ascii=True)
        chain = hashlib.sha256(f"{chain}{body}".encode()).hexdigest()
        lines.append(f'{body[:-1]}, "digest": "{chain}"}}\n')
    return "".join(lines).encode(), chain


def _apply(line: bytes, chain: str | None, pending: dict[str, Ticket]) -> str | None:
    if chain is not None:  # else a journal of the first version, which has no digests
        sealed = _SEALED.fullmatch(line)
        line = sealed[1] + b"}" if sealed else b""
        digest = hashlib.sha256(chain.encode() + line).hexdigest()
        if sealed is None or digest != sealed[2].decode():
            raise ValueError("the line has another digest")
        chain = digest
    _replay(line, pending)
    return chain


def _replay(body: bytes, pending: dict[str, Ticket]) -> None:
    try:
        record = json.loads(body)
        if record.keys() == {"done"}:
            pending.pop(record["done"], None)
            return
        ticket = Ticket.from_data(record)
        pending[ticket.operation] = ticket
    except (TypeError, LookupError, AttributeError, RecursionError) as error:
        raise ValueError("the line is not an entry") from error


# ---- the journals of all processes that serve a state repo on this machine ----

_JOURNALS = "slot-*/outbox.jsonl"
# A file of this name and an operation id beside a journal asks its process to give the demand up.
_DROP = "drop-"


def open_journal(folder: Path) -> Journal:
    """Return the journal of a slot, with the demands of dead processes in other slots."""
    journal = Journal(folder / "outbox.jsonl")
    # Each entry is written here before the old journal is removed. If a crash in between leaves the
    # entry in both journals, it still counts once, because its operation id is the same.
    for other in sorted(folder.parent.glob(_JOURNALS)):
        held = lock(other.parent) if other.parent != folder else None
        if held is not None:
            with held:
                journal.append(read(other).values())
                for request in other.parent.glob(f"{_DROP}*"):
                    request.replace(folder / request.name)
                other.unlink()
    return journal


@dataclass(frozen=True, slots=True)
class FoundJournal:
    file: Path
    demands: list[Ticket]  # that are not done and can be read
    damage: str = ""  # the error of reading the journal, if any
    set_aside: Path | None = None  # the file's new path, if it was renamed


def find_journals(root: Path, now: datetime, *, set_aside: bool) -> Iterator[FoundJournal]:
    # Those that have demands or are damaged. With ``set_aside``, each damaged journal is renamed,
    # unless a running process uses it.
    for file in sorted(root.glob(_JOURNALS)):
        try:
            demands = list(read(file).values())
            if demands:
                yield FoundJournal(file, demands)
        except OSError as error:
            message = f"{file} cannot be read: {error.strerror}; check this path, then try again"
            raise StateRepoError(message) from None
        except DamagedJournal as damage:
            moved = None
            held = lock(file.parent) if set_aside else None
            if held is not None:
                with held:
                    moved = file.rename(file.with_name(f"outbox-{now:%Y%m%dT%H%M%S}.damaged"))
                    sync_folder(file.parent)
            pending: dict[str, Ticket] = {}
            for line in (moved or file).read_bytes().split(b"\n"):
                sealed = _SEALED.fullmatch(line)
                with suppress(ValueError):
                    _replay(sealed[1] + b"}" if sealed else line, pending)
            yield FoundJournal(file, [*pending.values()], str(damage), moved)


def drop(root: Path, operation: str) -> Path | None:
    """Give a demand up; return the file that asks a process to do so, until it is answered."""
    for file in sorted(root.glob(_JOURNALS)):
        if (ticket := read(file).get(operation)) is None:
            continue
        held = lock(file.parent)
        if held is None:
            request = file.with_name(f"{_DROP}{operation}")
            request.touch()
            return request
        with held:
            if ticket.proposal is not None:
                branch = ticket.proposal.branch
                raise StateRepoError(
                    f"demand {operation} awaits approval on {branch}; turn it down with "
                    f"`demandops reject {branch} -m REASON`"
                )
            journal = Journal(file)
            journal.mark_done([operation], durably=True)
            journal.close()
        return None
    raise StateRepoError(
        f"no journal on this machine has a demand with the operation id {quoted(operation)}; "
        "`demandops journal` lists those that it has"
    )
