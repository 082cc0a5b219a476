"""Repositories: what others left there or set, and what is known of their past."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
from demandops.base.errors import StateRepoError, Unsound
from demandops.repo.git.remote_repository import connect
from demandops.repo.git.repository import StateRepository
from demandops.serve.journal import Journal

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.goals import EXPERIMENT
from tests.kit.repo import Person, git, tip

# ---- leftovers of killed processes, and repos that are refused ----


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


# ---- hooks and settings of its own: it is left as by `git push` ----


@pytest.fixture(params=[0o077, 0o022])
def mask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


@pytest.mark.parametrize(
    ("shared", "file", "folder"),
    [("group", 0o440, 0o770), ("world", 0o444, 0o775), ("0640", 0o440, 0o750)],
)
def test_a_shared_repository_stays_shared(
    bare: Path, demandops: Run, mask: int, person: Person, shared: str, file: int, folder: int
) -> None:
    git(bare, "config", "core.sharedRepository", shared)
    git(bare, "config", "core.logAllRefUpdates", "always")
    written = {bare / "refs" / "heads" / "main"}
    for step in EXPERIMENT[:2]:
        before = {*bare.rglob("*")} - written
        assert demandops("request", step, "--state-repo", bare).code == 0
        for path in {*bare.rglob("*")} - before:
            least = folder if path.is_dir() else file
            assert stat.S_IMODE(path.stat().st_mode) & least == least, path
        person.policy(approval="required")  # the next one becomes a branch
        written.clear()
    assert (bare / "refs" / "heads" / "demand").is_dir()
    rig.assert_sound(bare)


@pytest.mark.parametrize("hook", ["post-receive", "post-update", "reference-transaction"])
@pytest.mark.parametrize("folder", ["hooks", "our-own"])
def test_a_hook_learns_of_each_commit(bare: Path, demandops: Run, hook: str, folder: str) -> None:
    rig.hook(bare, hook, 'echo "$@" >> told; cat >> told').parent.rename(bare / folder)
    git(bare, "config", "core.hooksPath", folder)
    assert demandops("request", EXPERIMENT[0], "--state-repo", bare).code == 0
    assert "refs/heads/main" in (bare / "told").read_text()
    assert not list(bare.glob("objects/pack/*.keep"))


# ---- which of two commits is later, and what differs between them ----

CHART = "appdefs/object-detection-fusion/charts/object-fusion"
UNKNOWN = "f" * 40


def test_what_changed_between_commits_is_known(bare: Path, person: Person, tmp_path: Path) -> None:
    first = rig.tip(bare)
    other = person.change({"notes.txt": "one\n"})
    chart = person.change({f"{CHART}/notes.txt": "two\n"})
    repo = connect(str(bare), tmp_path / "data")
    assert repo.includes(chart, first) and repo.includes(other, other)
    assert not repo.includes(first, other)
    assert not repo.includes(UNKNOWN, first)
    assert repo.unchanged(first, other, CHART)
    assert not repo.unchanged(first, chart, CHART)
    assert not repo.unchanged(first, other, ".")
    # a folder or commit that does not exist equals nothing
    assert not repo.unchanged(first, other, "no/such/folder")
    assert not repo.unchanged(first, UNKNOWN, CHART)
    assert not repo.unchanged("", first, CHART)
    assert repo.changed_paths(first, chart) == [f"{CHART}/notes.txt", "notes.txt"]
    assert repo.changed_paths(chart, chart) == []
    assert repo.changed_paths("", chart) is repo.changed_paths(UNKNOWN, chart) is None
    bare.rename(bare.with_name("moved.git"))  # a damaged clone is away while it is made anew
    assert not repo.includes(chart, first)


def test_a_generator_answers_for_the_past_without_another_clone(url: str, data_home: Path) -> None:
    with rig.running(url) as generator:
        first, _ = rig.book(generator, rig.goal(1), rig.goal(2))
        ledger = generator.snapshot_at(first.commit).state.ledger
        assert ledger.claims_with("requester", "user1") and not ledger.claims_with(
            "requester", "user2"
        )
    assert [path.name for path in next(data_home.iterdir()).iterdir()] == ["slot-0"]
