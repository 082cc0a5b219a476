"""Leftovers of killed processes and failed syncs in a state repo, and repos that are refused."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path

import pytest
from demandops.base.errors import StateRepoError, Unsound
from demandops.repo.git.repository import StateRepository
from demandops.serve.journal import Journal

from tests.kit import rig
from tests.kit.repo import git, tip


def _leave(bare: Path) -> list[Path]:
    """Make the leftovers of a process that was killed while it wrote a pack; return their paths."""
    folder = bare / "demandops-pack-killed"
    folder.mkdir()
    (folder / "pack_git2_1").write_text("half of a pack")
    index = next((bare / "objects" / "pack").glob("*.idx"))
    keep = index.with_suffix(".keep")
    keep.hardlink_to(index)
    return [folder, keep]


@pytest.mark.parametrize("is_written", [False, True])
def test_a_start_removes_what_a_killed_process_left_unless_another_writes_a_pack(
    bare: Path, is_written: bool
) -> None:
    left = _leave(bare)
    of_a_person = bare / "objects" / "pack" / "pack-1.keep"
    of_a_person.write_text("")
    handle = os.open(bare / "objects" / "pack", os.O_RDONLY)
    try:
        if is_written:
            fcntl.flock(handle, fcntl.LOCK_SH)
        with rig.running(bare):
            assert [path.exists() for path in (*left, of_a_person)] == [is_written] * 2 + [True]
    finally:
        os.close(handle)


def test_a_published_demand_without_an_answer_is_written_to_new_files(bare: Path) -> None:
    with rig.running(bare) as generator:
        before = tip(bare)
        rig.receipt(generator.submit(rig.goal(1), "op-1"))
        journal = generator._slot.folder / "outbox.jsonl"
    branch, packs = bare / "refs/heads/main", bare / "objects" / "pack"
    inodes = {path.name: path.stat().st_ino for path in (branch, *packs.iterdir())}
    at = tip(bare)
    again = Journal(journal)  # a journal as before the answer
    again.append([rig.journaled("op-1", rig.goal(1), "2026-03-01T00:00:00+00:00", before)])
    again.close()
    assert rig.restart(bare) is True
    assert (tip(bare), rig.operations(bare)) == (at, ["op-1"])
    assert branch.stat().st_ino != inodes["main"]
    assert any(path.stat().st_ino != inodes.get(path.name) for path in packs.glob("*.pack"))
    rig.assert_sound(bare)


def test_a_journal_whose_sync_fails_answers_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(tmp_path / "outbox.jsonl")
    entry = rig.journaled("op-1", {}, "2026-03-01T00:00:00+00:00", "")

    def fail(file: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fdatasync", fail)
        with pytest.raises(Unsound, match="Input/output error; check its disk, then start again"):
            journal.append([entry])
    with pytest.raises(Unsound):
        journal.append([entry])


def test_a_repo_that_borrows_objects_is_refused(bare: Path, tmp_path: Path) -> None:
    git(tmp_path, "clone", "--quiet", "--bare", "--shared", str(bare), "borrows.git")
    with pytest.raises(StateRepoError, match="borrows objects of another repository"):
        StateRepository(tmp_path / "borrows.git")


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "corrupted loose reference file"),
        ("x" * 40 + "\n", "corrupted loose reference file"),
        ("1" * 40 + "\n", f"Git object {'1' * 40} is missing"),
    ],
)
def test_a_branch_that_cannot_be_read_is_told_with_the_remedy(
    bare: Path, text: str, what: str
) -> None:
    branch = bare / "refs/heads/main"
    branch.parent.mkdir(exist_ok=True)
    branch.write_text(text)
    remedy = f"{what}.*; check its disk .* restore them from a backup"
    with pytest.raises(StateRepoError, match=remedy):
        StateRepository(bare)
