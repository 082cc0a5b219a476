"""Errors while a demand is published: who gets which message, and what is tried again."""

from __future__ import annotations

import errno
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import git as gitpython
import pygit2
import pytest
from demandops.base import settings
from demandops.base.errors import StateRepoError, Unsound
from demandops.base.runtime import Runtime
from demandops.repo import reader
from demandops.repo.git.remote_repository import RemoteRepository
from demandops.repo.git.repository import (
    DiskFull,
    PushDenied,
    RemoteAway,
    StateRepository,
    disk_error,
)
from demandops.repo.git.signing import create_commit
from demandops.repo.git.tree import commit_of
from demandops.repo.history.commit_message import generator_signature
from demandops.serve.generator import Generator
from pygit2 import Oid, Repository

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.connections import IMAGES
from tests.kit.limits import files_end_at
from tests.kit.memory import NOW
from tests.kit.repo import git, tip
from tests.kit.rig import Person, Stages, goal


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ENOSPC, DiskFull),
        (errno.EDQUOT, DiskFull),
        (errno.EACCES, PushDenied),
        (errno.EROFS, PushDenied),
        (errno.EIO, Unsound),
        (errno.ENOENT, type(None)),
    ],
)
def test_an_error_of_a_disk_is_known_by_number_or_text(number: int, kind: type) -> None:
    of_python = OSError(number, os.strerror(number))
    of_libgit2 = OSError(f"failed to write out file: {os.strerror(number)}")
    for error in (of_python, of_libgit2):
        assert type(disk_error(error, "fleet.git")) is kind


def test_a_folder_that_cannot_be_used_is_no_fault_of_the_program(
    bare: Path, tmp_path: Path
) -> None:
    slot = tmp_path / "data" / "slot-0"
    slot.parent.mkdir()
    slot.write_text("")
    with pytest.raises(StateRepoError) as error:
        Generator(str(bare), data=slot.parent)
    assert str(error.value).startswith(
        f"the data folder of {bare} cannot be read: [Errno 17] File exists: '{slot}'; check its "
        "disk and its files"
    )


def test_a_full_disk_keeps_demands_waiting_until_there_is_room(
    bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        stages = Stages()
        journal = generator._slot.folder / "outbox.jsonl"
        # room for a journal entry, not for a pack
        with files_end_at(journal.stat().st_size + 1500):
            ticket = generator.submit(goal(2), listener=stages)
            rig.wait_until(
                lambda: ticket.future.done() or "away" in stages.names, "the requester is told"
            )
            told = dict(stages.told).get("away", "")
            assert "its disk has no room (File too large); free some" in told
            assert "no room" in generator.remote_status.unreachable
        assert rig.receipt(ticket).outcome == "booked"
    assert caplog.text.count("trying again") == 1
    rig.assert_sound(bare)


def test_an_io_error_ends_the_process_and_the_next_start_goes_by_the_journal(bare: Path) -> None:
    runtime = Runtime()
    generator = Generator(str(bare), runtime=runtime)
    broken = OSError(errno.EIO, os.strerror(errno.EIO))

    def fail(stage: str, text: str) -> None:
        if stage == "committed":
            generator._repository.objects = _Broken(generator._repository.objects, broken)

    ticket = generator.submit(goal(1), "op-1", fail)
    with pytest.raises(Unsound, match=r"Input/output error; check its disk"):
        rig.receipt(ticket)
    assert generator.close(timeout=5) is False
    assert rig.operations(bare) == []
    assert rig.restart(bare) is True
    assert rig.operations(bare) == ["op-1"]


class _Broken:
    """A repository whose references cannot be read, because of an error of the disk."""

    def __init__(self, repo: pygit2.Repository, error: OSError) -> None:
        self._repo, self._error = repo, error

    def __getattr__(self, name: str) -> object:
        if name == "references":
            raise self._error
        return getattr(self._repo, name)


def test_a_demand_on_main_is_not_refused_because_its_folder_could_not_be_synced(bare: Path) -> None:
    with rig.running(bare) as generator:

        def deny(stage: str, text: str) -> None:
            if stage == "committed":
                generator._repository.objects = _Moved(generator._repository)

        ticket = generator.submit(goal(1), "op-1", deny)
        assert rig.receipt(ticket).commit == tip(bare)
    assert rig.operations(bare) == ["op-1"]


class _Moved:
    """A repository that moves its branch once, and then fails to sync the branch's folder."""

    def __init__(self, repository: StateRepository) -> None:
        self._repository, self._objects = repository, repository.objects
        self.references = {repository.main_reference: self}

    @property
    def target(self) -> pygit2.Oid:
        return self._objects.references[self._repository.main_reference].target

    def set_target(self, *arguments: str) -> None:
        repository = self._repository
        repository.objects = self._objects
        repository.objects.references[repository.main_reference].set_target(*arguments)
        raise OSError(errno.EACCES, os.strerror(errno.EACCES))

    def __getattr__(self, name: str) -> object:
        return getattr(self._objects, name)


def test_a_lock_that_is_no_file_is_told_and_not_waited_for_in_silence(bare: Path) -> None:
    with rig.running(bare) as generator:
        stages = Stages()
        lock = bare / "refs" / "heads" / "main.lock"
        lock.mkdir()
        generator.submit(goal(1), listener=stages)
        rig.wait_until(lambda: "away" in stages.names, "the requester is told", 20)
        lock.rmdir()
    rig.assert_sound(bare)


# ---- a tip that cannot be read ----


def _commit_by_hand(
    bare: Path,
    tree: pygit2.Oid | None = None,
    time: int = 1_770_000_000,
    more: str = "",
    people: str = "",
) -> None:
    """Point main at a commit that no Git library would write."""
    repo, parent = pygit2.Repository(str(bare)), tip(bare)
    people = people or f"Petra <petra@example.org> {time} +0000"
    text = (
        f"tree {tree or repo[parent].peel(pygit2.Tree).id}\nparent {parent}\nauthor {people}\n"
        f"committer {people}\n{more}\nHello\n"
    )
    made = repo.write(pygit2.enums.ObjectType.COMMIT, text.encode())
    repo.references["refs/heads/main"].set_target(made)


def _with_entry_in_overrides(bare: Path, name: bytes, blob: pygit2.Oid) -> pygit2.Oid:
    """Return main's tree, but with only one entry in ``overrides/``: ``blob`` as ``name``."""
    repo = pygit2.Repository(str(bare))
    tree = repo.TreeBuilder(repo[tip(bare)].peel(pygit2.Tree))
    made = repo.write(pygit2.enums.ObjectType.TREE, b"100644 %s\0%s" % (name, blob.raw))
    tree.insert("overrides", made, pygit2.enums.FileMode.TREE)
    return tree.write()


def test_a_tip_that_cannot_be_read_is_told_once_and_tried_again_with_pauses(
    bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with rig.running(bare, fetch_interval=0.01) as generator:
        rig.book(generator, goal(1))
        good = tip(bare)
        missing = pygit2.Oid(raw=b"\x11" * 20)
        _commit_by_hand(bare, _with_entry_in_overrides(bare, b"gone.yaml", missing))
        rig.wait_until(lambda: "writer" in generator.failures, "the failure is shown")
        with pytest.raises(
            StateRepoError, match=r"overrides/gone\.yaml of commit .* is missing or damaged"
        ):
            rig.receipt(generator.submit(goal(2)))
        assert caplog.text.count("is missing or damaged") == 1
        pygit2.Repository(str(bare)).references["refs/heads/main"].set_target(good)
        rig.book(generator, goal(3))
        rig.wait_until(lambda: "writer" not in generator.failures, "the writer works again")
    rig.assert_sound(bare)


def test_a_commit_that_cannot_be_read_is_told_and_refused_at_a_push(
    bare: Path, tmp_path: Path
) -> None:
    git(tmp_path, "clone", "--quiet", "--bare", str(bare), "clone.git")
    _commit_by_hand(tmp_path / "clone.git", people="Petra 1770000000 +0000")  # no e-mail
    push = ("push", "--quiet", str(bare), "main:main")
    made = tip(tmp_path / "clone.git")
    with pytest.raises(AssertionError, match=f"object {made}: missingEmail"):
        git(tmp_path / "clone.git", *push)
    with rig.running(bare) as generator:
        good = tip(bare)
        git(bare, "config", "receive.fsckObjects", "false")  # Git's default
        git(tmp_path / "clone.git", *push)
        with pytest.raises(StateRepoError) as error:
            rig.receipt(generator.submit(goal(1)))
        assert str(error.value) == (
            f"commit {made}: failed to parse signature - malformed e-mail; set the branch back to "
            "the commit before it"
        )
        git(bare, "update-ref", "refs/heads/main", good)
        rig.book(generator, goal(2))


def test_a_commit_in_an_unknown_encoding_is_like_any_other(bare: Path) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        _commit_by_hand(bare, more="encoding nonsense-7\n")
        assert rig.book(generator, goal(2))[0].outcome == "booked"


@pytest.mark.parametrize("time", [-62_000_000_000, 254_000_000_000, 2**62])
def test_a_commit_of_an_impossible_time_holds_back_its_files_alone(bare: Path, time: int) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        blob = pygit2.Repository(str(bare)).create_blob(b"x")
        _commit_by_hand(bare, _with_entry_in_overrides(bare, b"a.yaml", blob), time)
        assert rig.book(generator, goal(2))[0].outcome == "booked"
        assert {fault.file for fault in generator.snapshot.problems} == {"overrides/a.yaml"}
    with reader.opened(str(bare)) as opened:
        assert len(list(opened.log())) == 5


def test_a_file_whose_name_is_no_text_holds_back_itself_alone(bare: Path, person: Person) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        blob = pygit2.Repository(str(bare)).create_blob(b"x")
        _commit_by_hand(bare, _with_entry_in_overrides(bare, b"\xff.yaml", blob))
        assert rig.book(generator, goal(2))[0].outcome == "booked"
        assert {fault.file for fault in generator.snapshot.problems} == {"overrides/\\xff.yaml"}


# ---- a damaged clone ----


def _truncate_packs(clone: Path) -> None:
    for pack in clone.glob("objects/pack/*.pack"):
        pack.chmod(0o644)
        os.truncate(pack, pack.stat().st_size // 2)


def _drop_indexes(clone: Path) -> None:
    for index in clone.glob("objects/pack/*.idx"):
        index.unlink()


def _break_head(clone: Path) -> None:
    (clone / "HEAD").write_text("nonsense\n")


def _empty_config(clone: Path) -> None:
    (clone / "config").write_text("")


def _drop_objects(clone: Path) -> None:
    shutil.rmtree(clone / "objects")


@pytest.mark.parametrize(
    "damage", [_truncate_packs, _drop_indexes, _break_head, _empty_config, _drop_objects]
)
def test_a_damaged_clone_is_made_anew(
    url: str, bare: Path, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    data = tmp_path / "data"
    with rig.running(url, data=data) as generator:
        rig.book(generator, goal(1))
        clone = generator._slot.folder / "clone.git"
    rig.git(clone, "repack", "-adq")
    damage(clone)
    with rig.running(url, data=data) as generator:
        assert rig.book(generator, goal(2))[0].outcome == "booked"
    rig.assert_sound(bare)


@pytest.mark.parametrize("name", ["HEAD", "config"])
def test_a_clone_that_cannot_be_read_meanwhile_is_named_and_waited_for(
    url: str, bare: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    """If the clone's configuration is gone, git blames ``origin``; the log must name the clone."""
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        file = generator._slot.folder / "clone.git" / name
        away = file.rename(file.with_name("away"))
        ticket = generator.submit(goal(2))
        rig.wait_until(
            lambda: f"its clone {file.parent} cannot be read" in caplog.text,
            "the log names the clone",
        )
        assert not ticket.future.done()
        away.rename(file)
        assert rig.receipt(ticket).outcome == "booked"
    rig.assert_sound(bare)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (
            "warning: unable to access 'config': Permission denied\n"
            "fatal: unknown error occurred while reading the configuration files",
            "warning: unable to access 'config': Permission denied",
        ),
        ("!\tabc:refs/heads/main\t[remote rejected] (bad pack)", "bad pack"),
    ],
    ids=["unreadable-file", "server-lost-the-pack"],
)
def test_a_failure_of_a_disk_is_no_refusal_by_the_remote(
    url: str, tmp_path: Path, words: str, reason: str
) -> None:
    repository = RemoteRepository(url, tmp_path / "clone.git", print, allow_offline=False)
    error = repository.push_error(gitpython.GitCommandError(["push"], 1, words.encode()))
    assert isinstance(error, RemoteAway)
    assert str(error) == f"{url} cannot be pushed to: {reason}"


def test_a_demand_is_booked_although_what_was_packed_cannot_be_cleaned_up(
    address: str, bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **options: object) -> None:
        raise PermissionError(errno.EACCES, "of the folder itself")

    with rig.running(address) as generator:
        monkeypatch.setattr(shutil, "rmtree", fail)
        assert rig.book(generator, goal(1))[0].outcome == "booked"
        monkeypatch.undo()
    rig.assert_sound(bare)


def test_a_commit_that_is_not_there_is_no_mistake_of_a_person(bare: Path) -> None:
    with pytest.raises(StateRepoError, match=r"a{40} cannot be read; check the disk"):
        commit_of(Repository(str(bare)), Oid(hex="a" * 40))


def test_what_people_push_beside_a_damaged_clone_is_followed(
    url: str, bare: Path, person: Person
) -> None:
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        clone = generator._slot.folder / "clone.git"
    _break_head(clone)
    person.change({"README.md": "Hello\n"})
    with rig.running(url) as generator:
        rig.book(generator, goal(2))
        assert str(generator.snapshot.commit) == tip(bare)


def lose(repo: Path, tmp_path: Path, spec: str) -> str:
    """Remove an object from a bare repository; return its id."""
    lost = rig.git(repo, "rev-parse", spec).strip()
    packs = [path.replace(tmp_path / path.name) for path in repo.glob("objects/pack/*.pack")]
    for pack in packs:
        with pack.open("rb") as file:
            subprocess.run(["git", "unpack-objects", "-q"], cwd=repo, stdin=file, check=True)
    (repo / "objects" / lost[:2] / lost[2:]).unlink()
    return lost


@pytest.mark.parametrize("path", ["demandops.yaml", "inventory", "registry/images.yaml"])
def test_a_repo_of_this_disk_that_lost_a_file_is_told_with_the_remedy(
    bare: Path, tmp_path: Path, demandops: Run, path: str
) -> None:
    lost = lose(bare, tmp_path, f"main:{path}")
    with (
        pytest.raises(StateRepoError) as error,
        rig.running(str(bare), data=tmp_path / "data"),
    ):
        pass
    assert str(error.value).startswith(f"{bare} cannot be read: ") and lost in str(error.value)
    assert f"if `git -C {bare} fsck` finds it broken, restore it from a backup" in str(error.value)
    told = demandops("bookkeeping", "--state-repo", bare)
    commit = rig.git(bare, "rev-parse", "main")[:10]
    assert told.code == 1
    assert f"error: {bare} cannot be read: {path} of commit {commit}, Git object {lost}" in told.err
    assert "check its disk and its files" in told.err


def test_a_file_that_the_state_in_effect_had_and_git_lost_is_told(
    bare: Path, tmp_path: Path, person: Person
) -> None:
    """While a file is quarantined, its last valid version is read by its id."""
    valid = tip(bare)
    with rig.running(bare) as generator:
        person.change({IMAGES: "kind: [\n"})
        rig.book(generator, goal(1))
    lost = lose(bare, tmp_path, f"{valid}:{IMAGES}")
    command = [sys.executable, "-m", "demandops.cli.main", "bookkeeping", "--state-repo", str(bare)]
    told = subprocess.run(command, capture_output=True, text=True, check=False)  # without caches
    assert told.returncode == 1, told.stderr
    assert f"{IMAGES} of commit {valid[:10]}" in told.stderr
    assert lost in told.stderr


def test_a_checkout_that_lacks_a_file_is_told_by_check(
    bare: Path, tmp_path: Path, demandops: Run
) -> None:
    folder = tmp_path / "checkout"
    rig.git(tmp_path, "clone", "--quiet", "--no-local", str(bare), str(folder))
    lost = lose(folder / ".git", tmp_path, "HEAD:demandops.yaml")
    told = demandops("check", folder)
    assert told.code == 1
    assert f"demandops.yaml of commit {rig.git(folder, 'rev-parse', 'HEAD')[:10]}" in told.err
    assert lost in told.err


def test_a_branch_that_cannot_be_read_is_no_fault_of_the_program(
    bare: Path, demandops: Run
) -> None:
    branch = bare / "refs" / "heads" / "main"
    branch.unlink()
    branch.symlink_to(branch.name)  # not even root can read a link to itself
    ran = demandops("log", "--state-repo", bare)
    assert ran.code == 1, ran.err
    assert ran.err.startswith(f"error: {bare} cannot be read: ")


def test_a_folder_for_the_clone_that_cannot_be_used_is_no_fault_of_the_program(
    url: str, demandops: Run
) -> None:
    slot = settings.data_home(url) / "reader" / "slot-0"
    slot.parent.mkdir(parents=True)
    slot.write_text("")
    ran = demandops("log", "--state-repo", url)
    assert ran.code == 1, ran.err
    assert ran.err.startswith(f"error: the data folder of {url} cannot be read: ")


def test_a_full_disk_of_the_clone_is_told_at_a_push(url: str, bare: Path, tmp_path: Path) -> None:
    repository = RemoteRepository(url, tmp_path / "clone.git", print, allow_offline=False)
    before = repository.tip()
    tree, who = repository.objects[before].peel(pygit2.Tree).id, generator_signature(NOW)
    commit = create_commit(repository.new, None, (who, who), "Again\n", tree, [before])
    with files_end_at(10), pytest.raises(DiskFull, match=r"clone\.git cannot be written"):
        repository.publish(before, commit)


def test_a_remote_that_does_not_answer_is_told(url: str, tmp_path: Path) -> None:
    repository = RemoteRepository(url, tmp_path / "clone.git", print, allow_offline=False)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        place = f"git://127.0.0.1:{silent.getsockname()[1]}/state.git"
        with pytest.raises(gitpython.GitCommandError) as error:
            repository._run_git(repository._git, "ls-remote", place, timeout=0.2)
    message = str(repository.push_error(error.value))
    assert message == f"{url} cannot be pushed to: fatal: git timed out after 0.2 s"
