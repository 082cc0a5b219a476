"""Demands wait while the remote is away, and fail if the remote denies their push."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from demandops.base.errors import Refused, ShuttingDown, StateRepoError
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.rig import Gate, Stages, goal

# ---- away and back ----


def test_goals_stay_open_while_the_remote_is_away_and_are_published_once_it_is_back(
    url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with rig.running(url) as generator:
        rig.book(generator, goal(0))
        with rig.away(bare):
            stages = Stages()
            tickets = [generator.submit(goal(1), listener=stages)]
            rig.wait_until(lambda: "committed" in stages.names, "the first demand is committed")
            tickets += [generator.submit(goal(number)) for number in (2, 3)]
            rig.wait_until(
                lambda: "trying again" in caplog.text, "the log says that the generator tries again"
            )
            assert not any(ticket.future.done() for ticket in tickets)
        receipts = [rig.receipt(ticket) for ticket in tickets]
    assert [receipt.commit for receipt in receipts] == [commit.id for commit in rig.commits(bare)][
        1:
    ]
    assert stages.names == ["admitted", "booked", "committed", "away", "pushed"], (
        "each stage must be told once"
    )
    assert rig.books(bare) == rig.books_after(map(goal, range(4)))
    rig.assert_sound(bare)


def test_a_start_while_the_remote_is_away_goes_on_from_what_was_fetched_last(
    url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    generator = Generator(url)
    rig.book(generator, goal(0))
    with rig.away(bare):
        left = generator.submit(goal(1), "op-1")
        assert generator.close(timeout=0.3) is False
        with pytest.raises(ShuttingDown, match="stays in the journal"):
            left.future.result(0)
        with pytest.raises(StateRepoError, match="cannot be fetched"):
            Generator(url, start_offline=False)
        generator = Generator(url)
        assert "continuing with the commits of the last fetch" in caplog.text
        fresh = generator.submit(goal(2), "op-2")
        rig.wait_until(lambda: "trying again" in caplog.text, "the generator tries again")
        assert not fresh.future.done()
    rig.receipt(fresh)
    assert generator.close(rig.PATIENCE_S) is True
    assert rig.operations(bare)[-2:] == ["op-1", "op-2"]
    assert rig.books(bare) == rig.books_after(map(goal, range(3)))
    rig.assert_sound(bare)


def test_what_waits_in_the_journal_is_judged_on_what_the_remote_has_become(
    url: str, bare: Path, tmp_path: Path
) -> None:
    """While two joins wait in the journal, another generator books one of them and a third."""
    generator = Generator(url)
    with rig.away(bare):
        generator.submit(goal(1), "op-1")
        generator.submit(goal(2), "op-2")
        generator.close(timeout=0)
    with rig.running(url, data=tmp_path / "another-machine") as other:
        rig.book(other, goal(1), goal(3))
    assert rig.restart(url) is True
    assert "op-1" not in rig.operations(bare), (
        "a join that another generator booked must make no commit"
    )
    assert rig.operations(bare)[-1] == "op-2"
    assert rig.books(bare) == rig.books_after(map(goal, (1, 3, 2)))
    rig.assert_sound(bare)


def test_a_demand_that_the_new_tip_makes_impossible_is_refused_with_the_reason(
    url: str, bare: Path, tmp_path: Path
) -> None:
    elsewhere = goal(1)
    elsewhere["apps"][0]["header"]["node_id"] = "cloud"
    with rig.running(url) as generator:
        with rig.running(url, data=tmp_path / "another-machine") as other:
            rig.book(other, elsewhere)
        ticket = generator.submit(goal(6))  # the application of goal 1, but on the edge
        with pytest.raises(Refused, match="contradicts an existing claim"):
            rig.receipt(ticket)
        assert rig.book(generator, goal(2))[0].outcome == "booked"
    rig.assert_sound(bare)


def test_without_a_clone_a_remote_that_is_away_is_told_at_once(bare: Path) -> None:
    with pytest.raises(StateRepoError) as error:
        Generator(bare.with_name("nothing.git").as_uri())
    assert str(error.value).startswith(
        f"{bare.with_name('nothing.git').as_uri()} cannot be fetched"
    )


# ---- denied ----


@pytest.mark.parametrize("name", ["pre-receive", "update"])
def test_a_declined_push_fails_the_demand_with_the_hooks_words_and_leaves_no_trace(
    url: str, bare: Path, name: str
) -> None:
    with rig.running(url) as generator:
        rig.book(generator, goal(0))
        hook = rig.hook(bare, name, "echo 'main is frozen until Monday' >&2; exit 1")
        with pytest.raises(StateRepoError, match="main is frozen until Monday"):
            rig.receipt(generator.submit(goal(1), "op-denied"))
        hook.unlink()
        rig.book(generator, goal(2))
    assert "op-denied" not in rig.operations(bare)
    assert rig.claims(bare, "user1") == []
    assert rig.books(bare) == rig.books_after([goal(0), goal(2)])
    tip = rig.tip(bare)
    assert rig.restart(url) is True
    assert rig.tip(bare) == tip, "the journal must not have the declined demand"
    rig.assert_sound(bare)


def test_a_rejected_push_is_told_to_its_batch_and_a_refusal_to_the_refused_demand(
    url: str, bare: Path
) -> None:
    """``moved`` contradicts ``goal(2)`` of the same batch, but the batch is never published.

    So ``moved`` must fail because of the push, and not because of the contradiction.
    """
    gate = Gate()
    hook = rig.hook(bare, "pre-receive", "echo 'not today' >&2; exit 1")
    moved = goal(7)
    moved["apps"][0]["header"] = {"id": "edge/fusion-2", "node_id": "cloud"}
    with rig.running(url) as generator:
        tickets = [generator.submit(goal(1), listener=gate)]
        assert gate.reached.wait(rig.PATIENCE_S)
        refused = generator.submit(rig.impossible())
        tickets += [generator.submit(made) for made in (goal(2), goal(3), moved)]
        gate.open.set()
        for ticket in tickets:
            with pytest.raises(StateRepoError, match="rejects the push"):
                rig.receipt(ticket)
        with pytest.raises(Refused, match="nowhere"):
            rig.receipt(refused)
        hook.unlink()
        rig.book(generator, goal(4))
    assert rig.books(bare) == rig.books_after([goal(4)])
    rig.assert_sound(bare)


def test_the_requester_or_the_log_is_told_that_the_remote_cannot_take_a_push(
    url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The remote itself, not a hook, refuses the push, as it may do when its disk is full."""
    with rig.running(url) as generator:
        rig.git(bare, "config", "receive.maxInputSize", "1")
        ticket = generator.submit(goal(1))
        rig.wait_until(
            lambda: (
                ticket.future.done()
                or any(r.levelname in ("WARNING", "ERROR") for r in caplog.records)
            ),
            "the requester or the log has the reason",
        )
        rig.git(bare, "config", "--unset", "receive.maxInputSize")
        assert rig.book(generator, goal(2))[0].outcome == "booked"
        assert ticket.future.done()
    rig.assert_sound(bare)


def test_a_server_that_cannot_store_a_push_now_is_waited_for(
    url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with rig.running(url) as generator:
        objects, aside = bare / "objects", bare / "objects.aside"
        objects.rename(aside)
        (objects / "info").mkdir(parents=True)
        (objects / "info" / "alternates").write_text(f"{aside}\n")
        for number in range(256):  # the server fails to store objects
            (objects / f"{number:02x}").touch()
        ticket = generator.submit(goal(1))
        rig.wait_until(lambda: "cannot be pushed to: un" in caplog.text, "the log says why")
        assert not ticket.future.done()
        shutil.rmtree(objects)
        aside.rename(objects)
        assert rig.receipt(ticket).outcome == "booked"
    rig.assert_sound(bare)


@pytest.mark.parametrize(
    ("server", "told"),
    [
        (
            "echo 'git@edge: Permission denied (publickey).' >&2",
            "git@edge: Permission denied (publickey); git needs credentials for this address: a "
            "credential helper, ~/.netrc or an SSH key",
        ),
        (  # the server ends in the middle of its answer, and git complains of that last
            "printf '000eversion 2\\n'\n"
            "echo \"warning: unable to access 'config': Input/output error\" >&2\n"
            "echo 'fatal: unknown error occurred while reading the configuration files' >&2",
            "warning: unable to access 'config': Input/output error",
        ),
        (  # the server could not read the reference from its disk, and names a null id
            f"echo 'fatal: git upload-pack: not our ref {'0' * 40}' >&2",
            f"fatal: git upload-pack: not our ref {'0' * 40}; the server cannot read the branch: "
            "check the server's disk, and who may read the repository's files",
        ),
        (
            "echo \"fatal: detected dubious ownership in repository at '/srv/state.git'\" >&2",
            "fatal: detected dubious ownership in repository at '/srv/state.git'; check the path "
            "in the address, and who owns the repository's files",
        ),
    ],
    ids=["credentials", "cut off", "no reference", "owner"],
)
def test_a_remote_that_cannot_be_read_is_told_with_its_reason(
    server: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message leaves out git's last lines, which are the same whatever the reason is."""
    ssh = tmp_path / "ssh"
    ssh.write_text(f"#!/bin/sh\n{server}\nexit 255\n")
    ssh.chmod(0o755)
    monkeypatch.setenv("GIT_SSH_COMMAND", str(ssh))
    with pytest.raises(StateRepoError) as error:
        Generator("ssh://git@edge/state.git")
    assert str(error.value) == f"ssh://edge/state.git cannot be fetched: {told}"


def test_a_remote_with_main_checked_out_is_told_instead_of_tried_for_ever(
    bare: Path, tmp_path: Path
) -> None:
    work = tmp_path / "work"
    rig.git(tmp_path, "clone", "--quiet", str(bare), str(work))
    with rig.running(work.as_uri()) as generator:
        ticket = generator.submit(goal(1))
        with pytest.raises(StateRepoError, match="checked out"):
            rig.receipt(ticket)


def test_a_stale_lock_at_the_remote_is_told_in_the_log_and_survived(
    url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A killed receive-pack left the lock; a warning reports it, and the demand waits."""
    lock = bare / "refs" / "heads" / "main.lock"
    with rig.running(url) as generator:
        lock.touch()
        ticket = generator.submit(goal(1))
        rig.wait_until(
            lambda: any(r.levelname in ("WARNING", "ERROR") for r in caplog.records),
            "a warning tells that the push fails",
        )
        lock.unlink()
        assert rig.receipt(ticket).outcome == "booked"
    rig.assert_sound(bare)
