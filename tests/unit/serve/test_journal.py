"""The journal's file after a crash, on a full or damaged disk, and what forces it there."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pygit2
import pytest
from demandops.base.errors import StateRepoError
from demandops.repo import new_repo
from demandops.repo.git.remote_repository import Slot
from demandops.serve.journal import (
    DamagedJournal,
    Journal,
    ProposalRecord,
    Ticket,
    parse,
    read,
)

from tests.kit import plain_yaml
from tests.kit.chance import IN_FULL
from tests.kit.limits import files_end_at
from tests.kit.memory import NOW
from tests.kit.rig import journaled

PROPOSAL = ProposalRecord("demand/x", ("a",))


def entry(name: str, goal: object = "ü 🚗", proposal: ProposalRecord | None = None) -> Ticket:
    received = "2026-01-31T12:00:00+00:00"
    ticket = journaled(f"op-{name}", {"id": goal}, received, "bbbb")
    ticket.proposal = proposal
    return ticket


def data_of(tickets: Mapping[str, Ticket]) -> dict[str, Any]:
    return {operation: ticket.as_data() for operation, ticket in tickets.items()}


def pending(text: bytes) -> dict[str, Any]:
    return data_of(parse(text, Path("outbox.jsonl")))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "outbox.jsonl"


@pytest.fixture
def text(path: Path) -> bytes:
    """A journal as a kill leaves it: ``b`` is done, ``a`` is pending, and ``c`` is proposed."""
    journal = Journal(path)
    journal.append([entry("a"), entry("b")])
    journal.append([entry("c")])
    journal.mark_done(["op-b"])
    journal.append([entry("c", proposal=PROPOSAL)])
    return path.read_bytes()


def test_the_journal_reads_back_the_entries_that_are_not_done(path: Path, text: bytes) -> None:
    found = pending(text)
    assert list(found) == ["op-a", "op-c"]
    assert found["op-a"] == entry("a").as_data()
    assert found["op-c"]["proposal"] == asdict(PROPOSAL)
    assert data_of(Journal(path).pending) == found
    assert len(path.read_bytes().splitlines()) == 2, (
        "a start must leave out the demands that are done"
    )


def test_only_its_owner_reads_a_journal(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        Slot(tmp_path / "data" / "repo").close()
    finally:
        os.umask(before)
    for folder in (tmp_path / "data" / "repo", tmp_path / "data" / "repo" / "slot-0"):
        assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IRWXU


def test_a_torn_last_entry_is_dropped_and_gone_before_the_next_is_written(
    path: Path, text: bytes
) -> None:
    *lines, last = text.splitlines(keepends=True)
    before = pending(b"".join(lines))
    for length in range(len(last) - 1):
        assert pending(b"".join(lines) + last[:length]) == before
    whole = pending(text)
    assert pending(text[:-1]) == whole
    assert pending(text + b"\0" * 100) == whole, "a crash may leave pages of zeros"
    path.write_bytes(text[:-9])
    Journal(path).append([entry("d")])
    assert list(read(path)) == ["op-a", "op-c", "op-d"]


def test_no_flipped_bit_is_overlooked(path: Path, text: bytes) -> None:
    whole, overlooked = pending(text), []
    for position in range(len(text)):
        for bit in range(8) if IN_FULL else (position % 8,):
            changed = bytearray(text)
            changed[position] ^= 1 << bit
            try:
                if pending(bytes(changed)) != whole:
                    overlooked.append((position, bit))
            except DamagedJournal:
                pass
    assert overlooked == []


def test_no_missing_doubled_or_moved_entry_is_overlooked(path: Path, text: bytes) -> None:
    lines = text.splitlines(keepends=True)
    for at in range(len(lines) - 1):
        swapped = [*lines[:at], lines[at + 1], lines[at], *lines[at + 2 :]]
        for changed in (lines[:at] + lines[at + 1 :], lines[: at + 1] + lines[at:], swapped):
            with pytest.raises(DamagedJournal) as error:
                pending(b"".join(changed))
            assert str(error.value).startswith("outbox.jsonl: line ")


def test_the_file_stays_small_however_many_demands_pass_and_wait(path: Path) -> None:
    journal, waiting = Journal(path), 1000
    journal.append(entry(f"waiting-{number}") for number in range(waiting))
    largest = 0
    for number in range(100):
        batch = [entry(f"{number}-{each}", "x" * 100) for each in range(100)]
        journal.append(batch)
        journal.mark_done(each.operation for each in batch)
        largest = max(largest, path.stat().st_size)
    written = 10_000 * 300
    assert largest < (1 << 20) + 3 * waiting * 250 + 100 * 400 < written
    assert len(read(path)) == waiting


# ---- a full disk ----


def test_without_room_nothing_is_accepted_and_nothing_lost(path: Path) -> None:
    journal = Journal(path)
    journal.append([entry("a")])
    before = path.read_bytes()
    with files_end_at(path.stat().st_size + 50):
        for _ in range(2):
            with pytest.raises(StateRepoError, match=r"outbox\.jsonl cannot be written: File too"):
                journal.append([entry("b")])
            assert path.read_bytes() == before, "the file has a part of an entry"
            assert list(journal.pending) == ["op-a"]
    journal.append([entry("c")])
    assert list(read(path)) == ["op-a", "op-c"]


def test_without_room_a_withdrawal_fails_and_an_answer_does_not(path: Path) -> None:
    journal = Journal(path)
    journal.append([entry("a"), entry("b")])
    with files_end_at(path.stat().st_size + 10):
        with pytest.raises(StateRepoError):
            journal.mark_done(["op-a"], durably=True)
        assert list(journal.pending) == ["op-a", "op-b"]
        journal.mark_done(["op-b"])
    journal.append([entry("c")])
    assert list(read(path)) == ["op-a", "op-c"]


def test_a_journal_that_filled_the_disk_makes_room_once_all_is_done(path: Path) -> None:
    journal = Journal(path)
    journal.append([entry("a"), entry("b")])
    with files_end_at(path.stat().st_size + 10):
        journal.mark_done(["op-a", "op-b"])
        journal.append([entry("c")])
        journal.close()
    assert list(read(path)) == ["op-c"]


# ---- the first version's journal ----


def of_the_first_version(*records: object) -> bytes:
    return b"".join(json.dumps(record).encode() + b"\n" for record in records)


RECORDS = plain_yaml.beside(__file__)
WAITING, PROPOSED = RECORDS["waiting"], RECORDS["proposed"]


def test_the_first_version_s_journal_is_carried_over(path: Path) -> None:
    done = [{**WAITING, "operation": "op-3"}, {"done": "op-3"}]
    path.write_bytes(of_the_first_version(WAITING, PROPOSED, *done) + b'{"operation": "op-4"')
    found = read(path)
    assert list(found) == ["op-1", "op-2"]
    assert data_of(Journal(path).pending) == data_of(found)
    assert path.read_bytes().count(b'"digest"') == 2
    assert data_of(read(path)) == data_of(found)


@pytest.mark.parametrize(
    "line", [b"\x00\xff\n", b"[" * 9999 + b"\n", *map(of_the_first_version, RECORDS["not written"])]
)
def test_a_line_that_the_first_version_did_not_write_is_damage(line: bytes) -> None:
    with pytest.raises(DamagedJournal, match="line 2 is not what"):
        pending(of_the_first_version(WAITING) + line + of_the_first_version(PROPOSED))


LOADING = """
import pygit2
calls, known = [], pygit2.option
pygit2.option = lambda *args: calls.append([*map(int, args)]) or known(*args)
from demandops.serve import generator
print(*[call[1:] for call in calls if call[0] == pygit2.enums.Option.ENABLE_FSYNC_GITDIR])
"""


@pytest.mark.synced
def test_libgit2_git_and_the_journal_force_their_writes(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = [sys.executable, "-c", LOADING]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert said == "[1]\n", "libgit2's forced writes must be switched on once, and never off"
    new_repo.init(tmp_path / "made", NOW, bare=True, gitops="flux")
    assert pygit2.Repository(str(tmp_path / "made")).config["core.fsync"] == "committed"
    forced, force = list[int](), os.fdatasync
    monkeypatch.setattr(os, "fdatasync", lambda file: forced.append(file) or force(file))
    Journal(path).append([entry("a")])
    assert forced, "a demand must be on the disk before it is admitted"
