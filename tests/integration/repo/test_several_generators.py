"""Several generators write to one state repo at once: no demand is lost or counts twice."""

from __future__ import annotations

import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest
from demandops.repo.git import repository
from demandops.repo.git.objects import NewObjects
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.repo import Person
from tests.kit.rig import Drivers, demand, goal, leave

pytestmark = pytest.mark.synced


def test_two_processes_on_one_machine_lose_and_double_nothing(
    drivers: Drivers, bare: Path, data_home: Path
) -> None:
    lanes: list[list[list[dict[str, object]]]] = [[[], [], []], [[], [], []]]
    for number in range(24):  # of every three joins of a lane, one is followed by its leave
        lane = lanes[number % 2][number // 2 % 3]
        lane.append(demand(f"join-{number}", goal(number)))
        if number % 3 == 2:
            lane.append(demand(f"leave-{number}", leave(number)))
    told = rig.listen_to_all(drivers, [drivers.start(bare, each) for each in lanes])
    sent = [each for process in lanes for lane in process for each in lane]
    answers = {name: answer for one in told for name, answer in one.answers.items()}
    wrong = [each for each in answers.values() if each["outcome"] not in ("booked", "released")]
    assert wrong == []
    assert [one.finished for one in told] == [True, True]
    assert {path.name for path in next(data_home.iterdir()).iterdir()} == {"slot-0", "slot-1"}
    rig.assert_sound(bare, verify_last=10)
    assert sorted(rig.operations(bare)) == sorted(str(each["operation"]) for each in sent)
    assert rig.books(bare) == rig.books_after(each["goal"] for each in sent)
    assert {answer["commit"] for answer in answers.values()} <= {c.id for c in rig.commits(bare)}


def test_the_same_demand_at_two_generators_at_once_is_booked_once(
    url: str, bare: Path, tmp_path: Path
) -> None:
    with rig.running(url) as first, rig.running(url, data=tmp_path / "other") as second:
        for number in range(10):
            tickets = [one.submit(goal(number)) for one in (first, second)]
            assert sorted(map(rig.outcome, tickets)) == ["booked", "unchanged"]
    assert len(rig.operations(bare)) == 10
    rig.assert_sound(bare)


@pytest.mark.parametrize("after", ["the tip was read", "the branch was read"])
def test_what_another_writer_publishes_in_the_last_moment_is_not_overwritten(
    bare: Path, person: Person, monkeypatch: pytest.MonkeyPatch, after: str
) -> None:
    """Between a generator's last look at main and its own move of it."""
    places: dict[str, tuple[Any, str]] = {
        "the tip was read": (repository, "needs_push"),
        "the branch was read": (NewObjects, "packed"),
    }
    owner, name = places[after]
    last, moved = getattr(owner, name), list[str]()

    def then(*given: Any) -> Any:
        if not moved:
            moved.append("")
            moved[:] = [person.change({"README.md": "In the last moment\n"})]
        return last(*given)

    with rig.running(bare) as generator:
        monkeypatch.setattr(owner, name, then)
        rig.book(generator, goal(1))
    assert rig.git(bare, "merge-base", "--is-ancestor", moved[0], "main") == ""
    rig.assert_sound(bare)


def test_a_push_is_repeated_while_another_writer_locks_the_branch(
    generator: Generator, bare: Path
) -> None:
    """For example, `git push` or a second generator has the branch's lock while it writes."""
    lock = bare / "refs" / "heads" / "main.lock"
    lock.touch()
    let_go = threading.Timer(0.3, lock.unlink)
    let_go.start()
    try:
        rig.book(generator, goal(1))
    finally:
        let_go.join()
    rig.assert_sound(bare)


def test_housekeeping_by_git_during_demands_loses_nothing(generator: Generator, bare: Path) -> None:
    stop = threading.Event()

    def tidy_up() -> None:
        while not stop.is_set():
            for command in (["pack-refs", "--all"], ["gc", "--quiet"]):
                subprocess.run(["git", "-C", str(bare), *command], check=False, capture_output=True)

    thread = threading.Thread(target=tidy_up, daemon=True)
    thread.start()
    try:
        rig.book(generator, *map(goal, range(15)))
    finally:
        stop.set()
        thread.join(rig.PATIENCE_S)
    assert len(rig.operations(bare)) == 15
    rig.assert_sound(bare, verify_last=5)
