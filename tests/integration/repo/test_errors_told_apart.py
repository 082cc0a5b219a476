"""Errors while a demand is published: who gets which message, and what is tried again."""

from __future__ import annotations

import errno
import os
import socket
from pathlib import Path

import pygit2
import pytest
from demandops.base import settings
from demandops.base.errors import StateRepoError, Unsound
from demandops.repo import reader
from demandops.repo.git.remote_repository import RemoteRepository
from demandops.repo.git.repository import MAIN, PushDenied, Unavailable, disk_error
from demandops.repo.history.commit_message import generator_signature
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.limits import files_end_at
from tests.kit.memory import NOW
from tests.kit.repo import git, tip
from tests.kit.rig import Stages, goal


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ENOSPC, Unavailable),
        (errno.EDQUOT, Unavailable),
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
    generator = Generator(str(bare))
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


# ---- a tip that cannot be read ----


PETRA = b"Petra <petra@example.org> 1770000000 +0000"
LATIN_1 = b"Na\xefve caf\xe9 <someone@example.org> 1770000000 +0000"


def _commit_by_hand(
    bare: Path, who: bytes = PETRA, *, tree: pygit2.Oid | None = None, more: bytes = b""
) -> str:
    """Point main at a commit that no Git library would write; return its id."""
    repo, parent = pygit2.Repository(str(bare)), tip(bare)
    ids = (tree or repo[parent].peel(pygit2.Tree).id, parent)
    lines = b"tree %s\nparent %s\n" % tuple(str(id).encode() for id in ids)
    lines += b"author %s\ncommitter %s\n%s\nNa\xefve\n" % (who, who, more)
    made = repo.write(pygit2.enums.ObjectType.COMMIT, lines)
    repo.references["refs/heads/main"].set_target(made)
    return str(made)


def _with_entry_in_overrides(bare: Path, name: bytes, blob: pygit2.Oid | None = None) -> pygit2.Oid:
    """Return main's tree, but with only one entry in ``overrides/``: ``blob`` as ``name``."""
    repo = pygit2.Repository(str(bare))
    blob = blob or repo.create_blob(b"x")
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
        _commit_by_hand(bare, tree=_with_entry_in_overrides(bare, b"gone.yaml", missing))
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
    clone = tmp_path / "clone.git"
    git(tmp_path, "clone", "--quiet", "--bare", str(bare), clone.name)
    made = _commit_by_hand(clone, b"Petra 1770000000 +0000")  # no e-mail
    push = ("push", "--quiet", str(bare), "main:main")
    with pytest.raises(AssertionError, match=f"object {made}: missingEmail"):
        git(clone, *push)
    git(bare, "config", "receive.fsckObjects", "false")  # Git's default
    with rig.running(bare) as generator:
        git(clone, *push)
        with pytest.raises(StateRepoError, match=f"commit {made}: .*; set the branch back"):
            rig.receipt(generator.submit(goal(1)))


def _at(time: int) -> bytes:
    return b"Petra <petra@example.org> %d +0000" % time


@pytest.mark.parametrize(
    ("who", "encoding", "name"),
    [
        (PETRA, b"nonsense-7", b""),
        (LATIN_1, b"ISO-8859-1", b""),
        (LATIN_1, b"", b""),
        (_at(-62_000_000_000), b"", b"a.yaml"),
        (_at(254_000_000_000), b"", b"a.yaml"),
        (_at(2**62), b"", b"a.yaml"),
        (PETRA, b"", b"\xff.yaml"),
    ],
)
def test_a_commit_of_an_odd_encoding_or_time_is_like_any_other(
    bare: Path, who: bytes, encoding: bytes, name: bytes
) -> None:
    """What it holds that is not valid, like a file of an odd name, is held back alone."""
    tree = _with_entry_in_overrides(bare, name) if name else None
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        _commit_by_hand(bare, who, tree=tree, more=b"encoding %s\n" % encoding if encoding else b"")
        rig.book(generator, goal(2))
        held_back = [f"overrides/{name.decode(errors='backslashreplace')}"] if name else []
        assert [fault.file for fault in generator.snapshot.problems] == held_back
    with rig.running(bare) as generator:
        rig.book(generator, goal(3))
    with reader.opened(str(bare)) as opened:
        assert len(list(opened.log())) == len(rig.commits(bare)) + 1
    assert rig.differing(bare) == {}


# ---- what cannot be read ----


def test_a_clone_that_cannot_be_read_meanwhile_is_named_and_waited_for(
    url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        file = generator._slot.folder / "clone.git" / "HEAD"
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


def test_a_checkout_that_lacks_a_file_is_told_by_check(
    bare: Path, tmp_path: Path, demandops: Run
) -> None:
    folder = tmp_path / "checkout"
    rig.git(tmp_path, "clone", "--quiet", "--no-local", str(bare), str(folder))
    lost = rig.lose(folder / ".git", "HEAD:demandops.yaml")
    with (folder / "demandops.yaml").open("a") as file:
        file.write("# git would store the lost content again\n")
    told = demandops("check", folder)
    assert told.code == 1
    assert f"demandops.yaml of commit {rig.git(folder, 'rev-parse', 'HEAD')[:10]}" in told.err
    assert lost in told.err


@pytest.mark.parametrize("what", ["branch", "data"])
def test_what_cannot_be_read_or_used_is_no_fault_of_the_program(
    bare: Path, url: str, demandops: Run, what: str
) -> None:
    branch, slot = bare / "refs" / "heads" / "main", settings.data_home(url) / "reader" / "slot-0"
    if what == "branch":
        branch.unlink()
        branch.symlink_to(branch.name)  # not even root can read a link to itself
    else:
        slot.parent.mkdir(parents=True)
        slot.write_text("")
    ran = demandops("log", "--state-repo", bare if what == "branch" else url)
    of = f"{bare}" if what == "branch" else f"the data folder of {url}"
    assert (ran.code, ran.err.startswith(f"error: {of} cannot be read: ")) == (1, True)


def test_a_full_disk_of_the_clone_is_told_at_a_push(url: str, bare: Path, tmp_path: Path) -> None:
    repository = RemoteRepository(url, tmp_path / "clone.git")
    before = repository.tip()
    tree, who = repository.objects[before].peel(pygit2.Tree).id, generator_signature(NOW)
    commit = repository.new.add_commit(None, (who, who), "Again\n", tree, [before])
    with files_end_at(10), pytest.raises(Unavailable, match=r"clone\.git cannot be written"):
        repository.publish(before, commit)


def test_a_remote_that_does_not_answer_is_told(url: str, tmp_path: Path) -> None:
    repository = RemoteRepository(url, tmp_path / "clone.git")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        place = f"git://127.0.0.1:{silent.getsockname()[1]}/state.git"
        result = repository._run_git("ls-remote", place, timeout=0.2)
    message = str(repository.push_error(result, MAIN))
    assert message.startswith(f"{url} cannot be pushed to: fatal: git timed out after 0.2 s; check")
