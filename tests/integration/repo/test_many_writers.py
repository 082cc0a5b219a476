"""Several writers at one state repo at once: no demand is lost or counts twice.

The load is small in the gate; `make load` sends 2,000 demands and prints figures.
"""

from __future__ import annotations

import os
import random
import subprocess
import threading
import time
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from demandops.repo.git import repository
from demandops.repo.git.objects import NewObjects
from demandops.serve.generator import Generator

from tests.kit import git_over_http, rig
from tests.kit.limits import LONGEST_TEST_S
from tests.kit.rig import Drivers, Person, demand, goal

pytestmark = pytest.mark.synced

DEMANDS = int(os.environ.get("DEMANDOPS_LOAD_DEMANDS", "16"))
SEED = int(os.environ.get("DEMANDOPS_LOAD_SEED", "1"))
CUTS = 0.01
"""The probability that an HTTP request is cut before the server handles it.

With the same probability, it is cut before the answer.
"""
PERSONS_PAUSE_S = (0.5, 3.0) if DEMANDS > 100 else (0.2, 0.8)

Lanes = list[list[dict[str, Any]]]
"""The demands of a generator's requesters, each of whom sends again only after an answer."""


def lanes(generators: int, demands: int, requesters: int = 4) -> list[Lanes]:
    """Return the lanes of each generator; of every three joins, one is followed by its leave."""
    made: list[Lanes] = [[[] for _ in range(requesters)] for _ in range(generators)]
    for number in range(demands * 3 // 4):
        turn = number // generators
        lane = made[number % generators][turn % requesters]
        lane.append(demand(f"join-{number}", goal(number)))
        if turn % 3 == 2:
            lane.append(demand(f"leave-{number}", rig.leave(number)))
    return made


def assert_one_would_have_done_the_same(
    bare: Path, sent: list[Lanes], told: list[rig.Told], pushed: list[str]
) -> None:
    demands = [one for each in sent for lane in each for one in lane]
    answers = {name: answer for one in told for name, answer in one.answers.items()}
    assert [a for a in answers.values() if a["outcome"] not in ("booked", "released")] == []
    assert all(one.finished for one in told)
    assert sorted(answers) == sorted(one["name"] for one in demands)
    rig.assert_sound(bare, verify_last=20)
    assert sorted(rig.operations(bare)) == sorted(one["operation"] for one in demands)
    assert rig.books(bare) == rig.books_after(one["goal"] for one in demands)
    there = rig.git(bare, "rev-list", "main").splitlines()
    assert {answer["commit"] for answer in answers.values()} | {*pushed} <= {*there}


def test_two_processes_on_one_machine_lose_and_double_nothing(
    drivers: Drivers, bare: Path, data_home: Path
) -> None:
    sent = lanes(generators=2, demands=32)
    told = rig.listen_to_all([drivers.start(bare, each) for each in sent])
    assert {path.name for path in next(data_home.iterdir()).iterdir()} == {"slot-0", "slot-1"}
    assert_one_would_have_done_the_same(bare, sent, told, [])


def keep_pushing(person: Person, over: threading.Event, pushed: list[str]) -> None:
    dice = random.Random(SEED)
    for number in count(1):
        if over.wait(dice.uniform(*PERSONS_PAUSE_S)):
            return
        files = {f"notes/{number}.md": f"{number}\n"}
        if number % 5 == 0:  # a change after which all is rendered again
            images = "registry/images.yaml"
            files[images] = f"# change {number}\n{person.read(images)}"
        made = ""
        while not made and not over.is_set():
            with suppress(AssertionError):  # a generator pushed first
                made = person.push(files, f"Note {number}")
                pushed.append(made)


@pytest.mark.nightly
@pytest.mark.limit(LONGEST_TEST_S + DEMANDS)
def test_many_writers_end_where_one_would(
    drivers: Drivers, bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Four generators and a person, while connections are cut."""
    sent, over, dice = lanes(4, DEMANDS), threading.Event(), random.Random(SEED)
    with git_over_http.serving(bare.parent) as server:
        pushed: list[str] = []
        person = Person(bare, tmp_path / "person")
        started = time.monotonic()
        runs = [drivers.start(f"{server.url}/{bare.name}", each) for each in sent]
        people = threading.Thread(target=keep_pushing, args=(person, over, pushed), daemon=True)
        people.start()

        def begin_to_cut() -> None:
            server.faults.cuts = lambda: dice.random() < CUTS

        try:
            told = rig.listen_to_all(runs, begin_to_cut)
        finally:
            over.set()
        took = time.monotonic() - started
        people.join(rig.PATIENCE_S)
    with capsys.disabled():
        print(f"\n{DEMANDS} demands in {took:.1f} s, {server.cut} cuts")
        print(f"a person pushed {len(pushed)} times")
    assert_one_would_have_done_the_same(bare, sent, told, pushed)
    assert server.cut, "no connection was cut, so the test has tested nothing"


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
