"""What a killed process leaves is carried on, given up or told, and counts once.

``tests/faults`` kills a generator at each system call of a demand, and ``tests/simulation`` several
machines in the middle of a history.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from demandops.cli import state_repo
from demandops.serve.demands import GIVEN_UP
from demandops.serve.generator import Generator
from demandops.serve.journal import DamagedJournal

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.rig import Drivers, demand, goal

pytestmark = pytest.mark.synced

# ---- what was released stays released ----


@pytest.mark.parametrize("node", ["edge", "cloud"])
def test_what_was_answered_without_a_commit_is_not_booked_after_a_power_loss(
    bare: Path, data_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, node: str
) -> None:
    """``again`` changes nothing if its node is ``edge``, and is refused if it is ``cloud``.

    If ``again`` were decided once more after the release, it would be booked.
    """
    synced, again = {}, goal(1)
    again["apps"][0]["header"]["node_id"] = node

    def sync(handle: int) -> None:
        path = Path(f"/proc/self/fd/{handle}").readlink()
        synced[path] = path.read_bytes()

    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        monkeypatch.setattr(os, "fdatasync", sync)
        ticket = generator.submit(again)
        assert (ticket.future.exception(rig.PATIENCE_S) is None) == (node == "edge")
        left = dict(synced)
    with rig.running(bare, data=tmp_path / "another-machine") as other:
        rig.book(other, rig.leave(1))
    (journal,) = data_home.glob("*/slot-0/outbox.jsonl")
    journal.write_bytes(left[journal])

    assert rig.restart(bare) is True
    assert rig.claims(bare) == []


# ---- journals of dead processes ----


def _leave_pending(url: str, bare: Path, numbers: list[int]) -> None:
    """Make a generator accept demands that it cannot publish, and close it."""
    generator = Generator(url)
    with rig.away(bare):
        for number in numbers:
            generator.submit(goal(number), f"op-{number}")
        assert generator.close(timeout=0) is False


@pytest.mark.parametrize("whose", ["own", "orphan"])
def test_a_damaged_journal_stops_the_start_until_it_is_set_aside(
    url: str, bare: Path, data_home: Path, whose: str, demandops: Run
) -> None:
    _leave_pending(url, bare, [1, 2])
    journal = next(data_home.glob("*/slot-0/outbox.jsonl"))
    if whose == "orphan":  # in another slot than the one that the next process takes
        slot = journal.parent.with_name("slot-7")
        slot.mkdir()
        journal = journal.rename(slot / journal.name)
    text = journal.read_bytes().replace(b"op-1", b"op-9")
    journal.write_bytes(text)
    for _ in range(2):
        with pytest.raises(DamagedJournal) as error:
            Generator(url)
        assert str(error.value).startswith(f"{journal}: line 1 is not what the generator wrote")
    command = ("journal", "--state-repo", url)
    listed = demandops(*command)
    assert listed.code == 1
    assert "demandops journal --set-aside" in listed.err
    (row,) = demandops(*command, "--set-aside", "--output", "json").json()
    assert Path(row["set_aside"]).read_bytes() == text
    assert [each["operation_id"] for each in row["demands"]] == ["op-9", "op-2"]
    assert row["demands"][1]["goal"] == goal(2)
    with rig.running(url) as generator:
        rig.receipt(generator.submit(row["demands"][1]["goal"], "op-2"))
    assert rig.operations(bare) == ["op-2"]
    rig.assert_sound(bare)


def test_a_demand_that_is_dropped_is_not_carried_out_at_the_next_start(
    url: str, bare: Path, data_home: Path, demandops: Run, caplog: pytest.LogCaptureFixture
) -> None:
    _leave_pending(url, bare, [1, 2])
    command = ("journal", "--state-repo", url, "--drop")
    assert demandops(*command, "op-1").out.startswith("demand op-1 is given up; ")
    _leave_pending(url, bare, [3])
    journal = next(data_home.glob("*/slot-0/outbox.jsonl"))
    slot = journal.parent.with_name("slot-7")  # of a process that died before it gave op-3 up
    slot.mkdir()
    journal.rename(slot / journal.name)
    (slot / "drop-op-3").touch()
    listed = demandops("journal", "--state-repo", url).out
    assert "op-3  received 20" in listed and "2 demands are accepted" in listed
    assert demandops(*command, "op-1").err == (
        "error: no journal on this machine has a demand with the operation id 'op-1'; "
        "`demandops journal` lists those that it has\n"
    )
    assert rig.restart(url)
    assert rig.operations(bare) == ["op-2"]


def test_a_running_generator_answers_a_demand_that_is_dropped(
    url: str,
    bare: Path,
    demandops: Run,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    caplog.set_level("INFO", logger="demandops")
    command = ("journal", "--state-repo", url, "--output", "json", "--drop")
    with rig.running(url) as generator:
        with rig.away(bare):
            pushed = generator.submit(goal(1), "op-1")
            rig.wait_until(lambda: "trying again" in caplog.text, "the push fails")
            queued = generator.submit(goal(2), "op-2")
            rig.wait_until_queued([queued])
            monkeypatch.setattr(state_repo, "_DROP_S", rig.PATIENCE_S)
            assert demandops(*command, "op-2").json() == {
                "operation_id": "op-2",
                "outcome": "answered",
            }
            assert str(queued.future.exception(rig.PATIENCE_S)) == GIVEN_UP
            # its push may have arrived, so it waits for the state repo
            monkeypatch.setattr(state_repo, "_DROP_S", 0.0)
            assert demandops(*command, "op-1").json()["outcome"] == "requested"
            rig.wait_until(lambda: f"{GIVEN_UP}: demand op-1" in caplog.text, "it is told")
            assert not pushed.future.done()
        assert str(pushed.future.exception(rig.PATIENCE_S)) == GIVEN_UP
        rig.receipt(generator.submit(goal(3), "op-3"))
    assert rig.operations(bare) == ["op-3"]
    assert demandops("journal", "--state-repo", url).out.startswith("0 demands")


def test_two_processes_have_slots_of_their_own_and_a_dead_ones_journal_is_adopted(
    drivers: Drivers, bare: Path, url: str, data_home: Path
) -> None:
    with rig.running(url) as first:
        # a second process is killed beside the first, with a demand in its journal
        told = rig.listen(drivers.start(url, [[demand("join-1", goal(1))]], dies=True))
        assert told.finished is None
        slots = sorted(path.name for path in next(data_home.iterdir()).iterdir())
        assert slots == ["slot-0", "slot-1"]
        rig.book(first, goal(2))
        assert len(rig.operations(bare)) == 1, (
            "the first generator must not read the other's journal yet"
        )
    assert rig.restart(url) is True
    assert "op-join-1" in rig.operations(bare)
    assert not list(data_home.glob("*/slot-1/outbox.jsonl"))
    rig.assert_sound(bare)


def test_the_journal_of_one_state_repo_is_never_played_into_another(
    drivers: Drivers, new_repo: Callable[[str], Path], tmp_path: Path
) -> None:
    """Two state repos have the same relative path, in different folders."""
    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there):
        folder.mkdir()
        new_repo(f"{folder.name}/state.git")
    rig.listen(drivers.start("state.git", [[demand("join-1", goal(1))]], cwd=here, dies=True))
    assert rig.restart(there / "state.git") is True
    assert rig.operations(there / "state.git") == []
    # the journal is found again however the folder is named
    assert rig.restart(here / "state.git") is True
    assert rig.operations(here / "state.git") == ["op-join-1"]
