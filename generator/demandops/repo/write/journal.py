"""The journal, and the slot that keeps it for one process."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import IO, Any

from demandops.base.errors import StateRepoError, Unsound
from demandops.model.demand.demand import UNSTARTED
from demandops.repo.git.objects import sync_folder
from demandops.repo.git.repository import disk_error

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

    def as_replaced(self) -> str:
        # nobody has seen a proposal without a commit, so the one that it replaces still counts
        return f"{self.branch} {self.commits[-1]}" if self.commits else self.replaces


# A line about a demand: operation, goal, received, base, and perhaps proposal, a ProposalRecord.
Record = dict[str, Any]
_KEYS = {"operation", "goal", "received", "base"}


class Journal:
    """The journal of one process. It is not thread-safe: the caller must hold a lock."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._unsound: Unsound | None = None
        self.pending = read(path)
        self._chain, self._size, self._limit, self._is_broken = "", 0, 0, True
        with self._explained("try again"):
            self._file = path.open("ab", buffering=0)
            self._rewrite()

    def require_sound(self) -> None:
        if self._unsound is not None:
            raise self._unsound

    def append(self, records: Iterable[Record]) -> None:
        """Write and fsync all ``records``, or raise StateRepoError and write none of them.

        Unsound is raised if nobody knows whether they are written.
        """
        records = list(records)
        if records:
            with self._explained():
                self._write(records, durably=True)
            self.pending.update((record["operation"], record) for record in records)

    def mark_done(self, operations: Iterable[str], *, durably: bool = False) -> None:
        # With ``durably``, the removal is fsynced, and a failure raises StateRepoError and keeps
        # the demands. Otherwise the next append makes the removal durable. If the machine fails
        # before that, the demands are evaluated again after a restart. This is harmless if a commit
        # records their outcome, but a refused demand could be booked.
        done = [operation for operation in dict.fromkeys(operations) if operation in self.pending]
        records = [{"done": operation} for operation in done]
        if durably and done:
            with self._explained():
                self._write(records, durably=True)
        for operation in done:
            del self.pending[operation]
        if done and not durably:
            with suppress(OSError):
                self._write(records, durably=False)

    def close(self) -> None:
        # if this fails, the next process may evaluate again a demand that is done
        with suppress(OSError, Unsound):
            self._write([], durably=True)
        self._file.close()

    def _write(self, records: list[Record], *, durably: bool) -> None:
        self.require_sound()
        if self._size > self._limit:
            with suppress(OSError):  # the next write tries again
                self._rewrite()
        if self._is_broken:
            self._rewrite()
        text, chain = _sealed(records, self._chain)
        self._is_broken = True
        try:
            left = memoryview(text)
            while left:  # the system may write only a part
                left = left[os.write(self._file.fileno(), left) :]
            if durably:
                os.fdatasync(self._file.fileno())
        except OSError as error:
            self._require_known(error)
            try:
                self._file.truncate(self._size)
            except OSError:  # a restart could read demands that this process refuses
                self._unsound = Unsound(
                    f"the journal {self._path} cannot be written or truncated: {error.strerror}; "
                    "check its disk, then start again"
                )
                self.require_sound()
            raise
        self._is_broken, self._chain, self._size = False, chain, self._size + len(text)

    def _rewrite(self) -> None:
        text, chain = _sealed(self.pending.values(), "")
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

    def _require_known(self, error: OSError) -> None:
        reason = disk_error(error, f"the journal {self._path}")
        if isinstance(reason, Unsound):
            self._unsound = reason
            raise reason from None

    @contextmanager
    def _explained(self, remedy: str = "send the demand again") -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._require_known(error)
            raise StateRepoError(
                f"the journal {self._path} cannot be written: {error.strerror or error}; check its "
                f"disk, then {remedy}"
            ) from None


def read(path: Path) -> dict[str, Record]:
    return parse(path.read_bytes() if path.exists() else b"", path)


def parse(text: bytes, path: Path) -> dict[str, Record]:
    *lines, last = text.split(b"\n")
    chain = "" if _SEALED.fullmatch((lines or [last])[0]) else None
    pending: dict[str, Record] = {}
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


def _sealed(records: Iterable[Record], chain: str) -> tuple[bytes, str]:
    # the lines after one with the digest ``chain``, and the last digest
    lines = []
    for record in records:
        body = json.dumps(record, ensure_ascii=True, default=asdict)
        chain = hashlib.sha256(f"{chain}{body}".encode()).hexdigest()
        lines.append(f'{body[:-1]}, "digest": "{chain}"}}\n')
    return "".join(lines).encode(), chain


def _apply(line: bytes, chain: str | None, pending: dict[str, Record]) -> str | None:
    if chain is not None:  # else a journal of the first version, which has no digests
        sealed = _SEALED.fullmatch(line)
        line = sealed[1] + b"}" if sealed else b""
        digest = hashlib.sha256(chain.encode() + line).hexdigest()
        if sealed is None or digest != sealed[2].decode():
            raise ValueError("the line has another digest")
        chain = digest
    _replay(line, pending)
    return chain


def _replay(body: bytes, pending: dict[str, Record]) -> None:
    try:
        record = json.loads(body)
        if record.keys() == {"done"}:
            pending.pop(record["done"], None)
            return
        if (proposal := record.pop("proposal", None)) is not None:
            commits = tuple(proposal["commits"])
            proposal = {"proposal": ProposalRecord(**{**proposal, "commits": commits})}
        operation, base = record["operation"], record["base"]
        if record.keys() != _KEYS or not isinstance(operation, str) or not isinstance(base, str):
            raise ValueError("a key is missing or unknown, or an id is no text")
        received = datetime.fromisoformat(record["received"])
        if received.tzinfo is None or not 1970 <= received.year < UNSTARTED.year:
            raise ValueError("the time has no zone, or a year that no generator writes")
        pending[operation] = record | (proposal or {})
    except (TypeError, LookupError, AttributeError, RecursionError) as error:
        raise ValueError("the line is not an entry") from error


# ---- slots: a folder for the journal and the clone of each process ----

_MAX_SLOTS = 256
_JOURNAL = "outbox.jsonl"


class Slot:
    # Locked while its process lives. Several processes on one machine may serve one state repo.
    # Each takes the first free slot, and takes over the journals of dead processes.

    def __init__(self, root: Path) -> None:
        """Take a slot below ``root``; raise StateRepoError, or OSError about the slot's folder."""
        try:
            root.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise StateRepoError(
                f"the data folder {root} cannot be made: {error.strerror}; set DEMANDOPS_DATA_HOME "
                "to a writable folder"
            ) from None
        for number in range(_MAX_SLOTS):
            folder = root / f"slot-{number}"
            lock = _lock(folder)
            if lock is not None:
                self.folder, self._lock = folder, lock
                break
        else:
            raise StateRepoError(f"{_MAX_SLOTS} processes already use {root}; stop some of them")
        try:
            self.journal = Journal(self.folder / _JOURNAL)
            # Take over the journals of dead processes. Each entry is written here before the old
            # journal is removed. If a crash in between leaves the entry in both journals, it still
            # counts once, because its operation id is the same.
            for journal in sorted(root.glob(f"slot-*/{_JOURNAL}")):
                lock = _lock(journal.parent) if journal.parent != self.folder else None
                if lock is not None:
                    with lock:
                        self.journal.append(read(journal).values())
                        journal.unlink()
        except BaseException:
            self._lock.close()
            raise

    def close(self) -> None:
        self.journal.close()
        self._lock.close()


@dataclass(frozen=True, slots=True)
class FoundJournal:
    file: Path
    demands: list[Record]  # that are not done and can be read
    damage: str = ""  # the error of reading the journal, if any
    set_aside: Path | None = None  # the file's new path, if it was renamed


def find_journals(root: Path, now: datetime, *, set_aside: bool) -> Iterator[FoundJournal]:
    # Those that have demands or are damaged. With ``set_aside``, each damaged journal is renamed,
    # unless a running process uses it.
    for file in sorted(root.glob(f"slot-*/{_JOURNAL}")):
        try:
            demands = list(read(file).values())
            if demands:
                yield FoundJournal(file, demands)
        except OSError as error:
            message = f"{file} cannot be read: {error.strerror}; check this path, then try again"
            raise StateRepoError(message) from None
        except DamagedJournal as damage:
            moved = None
            lock = _lock(file.parent) if set_aside else None
            if lock is not None:
                with lock:
                    moved = file.rename(file.with_name(f"outbox-{now:%Y%m%dT%H%M%S}.damaged"))
                    sync_folder(file.parent)
            pending: dict[str, Record] = {}
            for line in (moved or file).read_bytes().split(b"\n"):
                sealed = _SEALED.fullmatch(line)
                with suppress(ValueError):
                    _replay(sealed[1] + b"}" if sealed else line, pending)
            yield FoundJournal(file, [*pending.values()], str(damage), moved)


def _lock(folder: Path) -> IO[str] | None:
    folder.mkdir(exist_ok=True, mode=0o700)
    handle = (folder / "lock").open("w")
    # the kernel releases this lock when the process dies in any way
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        handle.close()
        return None
    return handle
