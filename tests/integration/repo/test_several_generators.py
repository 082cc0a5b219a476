"""Several generators write to one state repo at once: no demand is lost or counts twice."""

from __future__ import annotations

import subprocess
import threading
from pathlib import Path

import pytest
from demandops.serve.generator import Generator
from demandops.serve.queue import Receipt, Ticket

from tests.kit import rig
from tests.kit.rig import Drivers, demand, goal, leave

pytestmark = pytest.mark.synced

EACH = 16


def _demands(who: int) -> list[tuple[str, rig.Goal]]:
    """Return one generator's demands; of every three joins, one is followed by a leave."""
    made = []
    for turn in range(EACH * 3 // 4):
        number = 2 * turn + who
        made.append((f"join-{number}", goal(number)))
        if turn % 3 == 2:
            made.append((f"leave-{number}", leave(number)))
    return made[:EACH]


def _assert_all_there(bare: Path) -> None:
    names = [*_demands(0), *_demands(1)]
    rig.assert_sound(bare, verify_last=10)
    assert sorted(rig.operations(bare)) == sorted(f"op-{name}" for name, _ in names)
    assert rig.books(bare) == rig.books_after(made for _, made in names)


def test_two_generators_in_one_process_lose_and_double_nothing(
    url: str, bare: Path, tmp_path: Path
) -> None:
    results: dict[str, Receipt] = {}
    failures: list[str] = []

    def client(generator: Generator, demands: list[tuple[str, rig.Goal]]) -> None:
        tickets: list[tuple[str, Ticket]] = []
        for name, made in demands:
            tickets.append((name, generator.submit(made, f"op-{name}")))
            if len(tickets) > 3:  # some demands are always open
                _note(*tickets.pop(0))
        for name, ticket in tickets:
            _note(name, ticket)

    def _note(name: str, ticket: Ticket) -> None:
        try:
            results[name] = rig.receipt(ticket)
        except Exception as error:
            failures.append(f"{name}: {error!r}")

    with rig.running(url) as first, rig.running(url, data=tmp_path / "other") as second:
        threads = [
            threading.Thread(target=client, args=(generator, _demands(who)), daemon=True)
            for who, generator in enumerate((first, second))
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(rig.PATIENCE_S)
    assert failures == []
    assert len(results) == 2 * EACH
    assert {r.outcome for r in results.values()} == {"booked", "released"}
    _assert_all_there(bare)
    there = {commit.id for commit in rig.commits(bare)}
    assert {receipt.commit for receipt in results.values()} <= there


def test_two_processes_on_one_machine_lose_and_double_nothing(
    drivers: Drivers, bare: Path, data_home: Path
) -> None:
    runs = []
    for who in (0, 1):
        demands = [demand(name, made) for name, made in _demands(who)]
        # a leave comes after its join, in the same lane
        lanes: list[list[dict[str, object]]] = [[], [], []]
        for item in demands:
            lanes[int(item["name"].rpartition("-")[2]) // 2 % 3].append(item)
        runs.append(drivers.start(bare, lanes))
    told = rig.listen_to_all(drivers, runs)
    answers = {name: answer for one in told for name, answer in one.answers.items()}
    assert [a for a in answers.values() if a["outcome"] not in ("booked", "released")] == []
    assert [one.finished for one in told] == [True, True]
    assert len(answers) == 2 * EACH
    slots = {path.name for path in next(data_home.iterdir()).iterdir()}
    assert slots == {"slot-0", "slot-1"}
    _assert_all_there(bare)


def test_the_same_demand_at_two_generators_at_once_is_booked_once(
    url: str, bare: Path, tmp_path: Path
) -> None:
    with rig.running(url) as first, rig.running(url, data=tmp_path / "other") as second:
        for number in range(10):
            tickets = [one.submit(goal(number)) for one in (first, second)]
            outcomes = sorted(rig.receipt(ticket).outcome for ticket in tickets)
            assert outcomes == ["booked", "unchanged"]
    assert len(rig.operations(bare)) == 10
    rig.assert_sound(bare)


def test_a_push_is_repeated_while_another_writer_locks_the_branch(bare: Path) -> None:
    """For example, `git push` or a second generator has the branch's lock while it writes."""
    lock = bare / "refs" / "heads" / "main.lock"
    with rig.running(bare) as generator:
        lock.touch()
        let_go = threading.Timer(0.3, lock.unlink)
        let_go.start()
        ticket = generator.submit(goal(1))
        try:
            assert rig.receipt(ticket).outcome == "booked"
        finally:
            let_go.join()
    rig.assert_sound(bare)


def test_housekeeping_by_git_during_demands_loses_nothing(bare: Path) -> None:
    stop = threading.Event()

    def tidy_up() -> None:
        while not stop.is_set():
            for command in (["pack-refs", "--all"], ["gc", "--quiet"]):
                subprocess.run(["git", "-C", str(bare), *command], check=False, capture_output=True)

    thread = threading.Thread(target=tidy_up, daemon=True)
    thread.start()
    try:
        with rig.running(bare) as generator:
            for number in range(15):
                rig.book(generator, goal(number))
    finally:
        stop.set()
        thread.join(rig.PATIENCE_S)
    assert len(rig.operations(bare)) == 15
    rig.assert_sound(bare, verify_last=5)
