"""After a kill at any time and a restart, each acknowledged demand is booked, and counts once."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from demandops.base import settings
from demandops.cli import state_repo
from demandops.model.demand import goals as demand_goals
from demandops.serve.demands import GIVEN_UP
from demandops.serve.generator import Generator
from demandops.serve.journal import DamagedJournal

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.rig import Drivers, Told, demand, goal, leave

pytestmark = pytest.mark.synced

KILLS = 15
LANES = 4


def _client(lane: int) -> list[tuple[str, rig.Goal]]:
    """Return a client's demands in order; of every three joins, two are followed by a leave."""
    made = []
    for turn in range(60):
        number = lane + turn * LANES
        made.append((f"join-{number}", goal(number)))
        if turn % 3:
            made.append((f"leave-{number}", goal(number, shutdown=True)))
    return made


@pytest.mark.parametrize("seed", [20260301])
def test_killed_at_random_moments_loses_and_doubles_nothing(
    drivers: Drivers, address: str, bare: Path, seed: int
) -> None:
    random = Random(f"{address.partition('://')[0]} {seed}")
    clients = [_client(lane) for lane in range(LANES)]
    acknowledged: dict[str, str] = {}
    sent: list[str] = []
    for turn in range(KILLS + 1):
        last = turn == KILLS
        lanes = []
        for client in clients:
            open_ = [(name, made) for name, made in client if name not in acknowledged]
            if last:  # finish the begun demands, and a few more
                open_ = open_[:2]
            # what has no answer yet is sent again, with a new operation id
            lanes.append([demand(name, made, f"op-{name}-try{turn}") for name, made in open_])
        run = drivers.start(address, lanes)
        delay = random.choice([random.uniform(0, 0.03), random.uniform(0.03, 0.16)])
        killer = threading.Timer(delay, run.kill)
        told = run.listen(on_ready=(lambda: None) if last else killer.start)
        _note(told, sent, acknowledged)
        sent += [name for name in told.sent if name not in sent]
    assert told.finished is True, "the last run, which nobody kills, must end by itself"

    rig.assert_sound(bare)
    made = {name: wanted for client in clients for name, wanted in client}
    in_history = [
        f"{'leave' if commit.one('Operation') == 'shutdown' else 'join'}-"
        f"{commit.one('Request-Id').removeprefix('demand-')}"
        for commit in rig.commits(bare)
    ]
    assert sorted(in_history) == sorted(acknowledged), (
        "each acknowledged demand must have one commit"
    )
    for name, commit in acknowledged.items():
        if commit:
            rig.git(bare, "merge-base", "--is-ancestor", commit, "main")
        assert name in in_history
    assert rig.books(bare) == rig.books_after(made[name] for name in acknowledged)


def _note(told: Told, sent: list[str], acknowledged: dict[str, str]) -> None:
    for name, answer in told.answers.items():
        # a repeated release may find that its first sending was carried out
        again = name in sent and "nothing that the shutdown lists is held" in answer["text"]
        assert answer["outcome"] in ("booked", "released", "unchanged") or again, answer
        acknowledged[name] = answer["commit"]


POINTS = {
    "committed:2": 1,  # a commit object exists, but no branch has it
    "publishing:2": 1,  # all commits of the batch exist, but none is published
    "published:2": 4,  # the remote has the commits, but the journal does not say so
    "unanswered:2": 4,  # the journal says that the demands are done, but nobody is told
}
"""Maps a point of the second batch or commit to the number of demands on main after the kill."""


@pytest.mark.parametrize("point", POINTS)
def test_killed_at_a_point_each_demand_is_committed_once(
    drivers: Drivers, address: str, bare: Path, point: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "demandops")
    lanes = [[demand(f"join-{number}", goal(number))] for number in (1, 2, 3)]
    told = drivers.start(address, lanes, opening=demand("join-0", goal(0)), die_at=point).listen()
    assert told.finished is None
    assert set(told.answers) == {"join-0"}
    assert len(rig.operations(bare)) == POINTS[point]
    assert rig.restart(address) is True
    assert ("resuming demand op-join-1 from" in caplog.text) is (point != "unanswered:2")
    assert sorted(rig.operations(bare)) == [f"op-join-{number}" for number in range(4)]
    rig.assert_sound(bare)
    assert rig.books(bare) == rig.books_after(map(goal, range(4)))
    caplog.clear()
    assert rig.restart(address) is True
    assert "from the journal" not in caplog.text


def test_a_published_demand_is_found_even_if_the_commit_before_it_is_gone(
    drivers: Drivers, bare: Path, tmp_path: Path
) -> None:
    """Somebody shortened the history while the generator was down."""
    drivers.start(bare, [[demand("join-1", goal(1))]], die_at="published").listen()
    lines = rig.git(bare, "cat-file", "commit", "main").split("\n")
    rootless = tmp_path / "commit"
    rootless.write_text("\n".join(line for line in lines if not line.startswith("parent ")) + "\n")
    root = rig.git(bare, "hash-object", "-t", "commit", "-w", str(rootless))
    rig.git(bare, "update-ref", "refs/heads/main", root)
    rig.git(bare, "reflog", "expire", "--expire=now", "--all")
    rig.git(bare, "gc", "--quiet", "--prune=now")

    with rig.running(bare) as generator:
        rig.book(generator, goal(2))
    assert rig.git(bare, "log", "--format=%B").count("op-join-1") == 1
    assert rig.books(bare) == rig.books_after([goal(1), goal(2)])


@pytest.mark.parametrize(
    ("point", "reason"),
    [("publishing:2", "unknown-node: "), ("published:2", "refused: .* but the reason was lost")],
)
def test_a_demand_that_is_refused_around_a_kill_is_refused_in_the_log(
    drivers: Drivers,
    address: str,
    bare: Path,
    point: str,
    reason: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    lanes = [[demand("wrong", rig.impossible())], [demand("right", goal(2))]]
    opening = demand("opening", goal(1))
    drivers.start(address, lanes, opening=opening, die_at=point).listen()
    with caplog.at_level("INFO", "demandops"):
        assert rig.restart(address) is True
    told = rf"demand op-wrong \('demand-0'\) from the journal: refused: {reason}"
    assert re.search(told, caplog.text)
    assert sorted(rig.operations(bare)) == ["op-opening", "op-right"]


def test_a_rollback_that_a_crash_left_in_the_journal_is_carried_out_at_the_next_start(
    bare: Path, drivers: Drivers
) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        to, then = rig.tip(bare), rig.books(bare)
        rig.book(generator, goal(2))
    who = ("A", "a@example.org")
    back = demand_goals.rollback(to, drop_newer=True, reason="a test", who=who).goal
    drivers.start(bare, [[demand("back", back)]], die_at="journaled").listen()
    assert rig.books(bare) != then
    assert rig.restart(bare)
    assert rig.books(bare) == then


# ---- what was released stays released ----


ELSEWHERE = goal(1)
ELSEWHERE["apps"][0]["header"]["node_id"] = "cloud"


@pytest.mark.parametrize(
    ("opening", "join", "committed"),
    [
        pytest.param(goal(0), goal(1), True, id="booked in the batch of its release"),
        # these have no commit, and after the release nothing is in their way
        pytest.param(goal(1), goal(1), False, id="without effect"),
        pytest.param(goal(1), ELSEWHERE, False, id="refused before the release"),
    ],
)
def test_a_join_in_the_batch_of_its_release_is_not_booked_by_a_replay(
    drivers: Drivers, url: str, bare: Path, opening: rig.Goal, join: rig.Goal, committed: bool
) -> None:
    lanes = [[demand("join", join)], [demand("leave", leave(1))]]
    begin = demand("begin", opening)
    drivers.start(url, lanes, opening=begin, die_at="published:2").listen()
    made = ["op-begin", *(["op-join"] if committed else []), "op-leave"]
    tip = rig.tip(bare)
    assert rig.operations(bare) == made
    assert rig.restart(url) is True
    assert (rig.tip(bare), rig.claims(bare, "user1")) == (tip, [])


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
        rig.book(other, leave(1))
    (journal,) = data_home.glob("*/slot-0/outbox.jsonl")
    journal.write_bytes(left[journal])

    assert rig.restart(bare) is True
    assert rig.claims(bare) == []


# ---- what a kill leaves lying about ----


def test_a_branch_lock_left_by_a_killed_generator_does_not_stop_the_next_one(
    drivers: Drivers,
    bare: Path,
) -> None:
    """libgit2 creates main.lock while it syncs the branch; the kill comes at that time."""
    lock = bare / "refs" / "heads" / "main.lock"
    told = drivers.start(bare, [[demand("join-1", goal(1))]], die_at="locked").listen()
    assert told.answers == {}
    an_hour_ago = lock.stat().st_mtime - 3600
    os.utime(lock, (an_hour_ago, an_hour_ago))  # makes the lock stale

    with rig.running(bare) as generator:
        rig.book(generator, goal(2))
    assert rig.operations(bare)[0] == "op-join-1"
    rig.assert_sound(bare)


@pytest.mark.parametrize("half_way", [False, True], ids=["lock", "cut off half way"])
def test_what_a_killed_generator_left_in_its_clone_does_not_stop_the_next_one(
    url: str, bare: Path, data_home: Path, half_way: bool
) -> None:
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
    clone = next(data_home.glob("*/slot-0/clone.git"))
    if half_way:
        for part in ("packed-refs", "refs/remotes/origin/main"):
            (clone / part).unlink(missing_ok=True)
        clone.with_name("clone.git.partial").mkdir()
    else:  # a living process would have locked the slot
        (clone / "refs/remotes/origin/main.lock").touch()
    with rig.running(url) as generator:
        rig.book(generator, goal(2))
    assert len(rig.operations(bare)) == 2
    rig.assert_sound(bare)


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


def test_the_accepted_demands_are_listed(url: str, bare: Path, demandops: Run) -> None:
    _leave_pending(url, bare, [1])
    listed = demandops("journal", "--state-repo", url).out.splitlines()
    assert listed[0].startswith("op-1  received 20")
    assert listed[1] == "1 demand is accepted and not published"
    assert rig.restart(url)
    assert demandops("journal", "--state-repo", url).out == (
        "0 demands are accepted and not published\n"
    )


def test_a_goal_that_this_version_cannot_read_is_refused_and_stops_no_start(
    url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    left = [
        rig.journaled(f"op-{number}", made, "2026-03-01T00:00:00+00:00", rig.tip(bare))
        for number, made in enumerate([{"colour": "red"}, goal(1)])
    ]
    rig.leave_in_journal(settings.data_home(url), *left)
    assert rig.restart(url)
    assert re.search(
        r"demand op-0 .* from the journal: refused: .* colour: is not a field", caplog.text
    )
    assert rig.operations(bare) == ["op-1"]


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
        told = drivers.start(url, [[demand("join-1", goal(1))]], die_at="journaled").listen()
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
    drivers.start("state.git", [[demand("join-1", goal(1))]], cwd=here, die_at="journaled").listen()
    assert rig.restart(there / "state.git") is True
    assert rig.operations(there / "state.git") == []
    # the journal is found again however the folder is named
    assert rig.restart(here / "state.git") is True
    assert rig.operations(here / "state.git") == ["op-join-1"]
