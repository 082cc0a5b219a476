"""Four generators and a person write to one state repo at once, while connections are cut.

The load is small in `make test`; `make load` sends 2,000 demands and prints the figures of each
writer.
"""

from __future__ import annotations

import os
import random
import statistics
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.kit import git_over_http, rig
from tests.kit.limits import LONGEST_TEST_S
from tests.kit.rig import Drivers, Goal

pytestmark = pytest.mark.synced

GENERATORS = 4
DEMANDS = int(os.environ.get("DEMANDOPS_LOAD_DEMANDS", "16"))
SEED = int(os.environ.get("DEMANDOPS_LOAD_SEED", "1"))
REQUESTERS = 4
"""How many requesters each generator has; a requester sends again only after an answer."""
CUTS = 0.01
"""The probability that an HTTP request is cut before the server handles it.

With the same probability, it is cut before the answer.
"""
PERSONS_PAUSE_S = (0.5, 3.0) if DEMANDS > 100 else (0.2, 0.8)


def _lanes(who: int) -> list[list[tuple[str, Goal]]]:
    """Return one generator's demands: a list for each of its :data:`REQUESTERS` requesters.

    Of every three joins, one is followed by a leave.
    """
    lanes: list[list[tuple[str, Goal]]] = [[] for _ in range(REQUESTERS)]
    for turn in range(DEMANDS // GENERATORS * 3 // 4):
        number, lane = GENERATORS * turn + who, lanes[turn % REQUESTERS]
        lane.append((f"join-{number}", rig.goal(number)))
        if turn % 3 == 2:
            lane.append((f"leave-{number}", rig.leave(number)))
    return lanes


@dataclass
class _Person:
    """A person who keeps changing the state repo, and repeats each push until it is accepted."""

    person: rig.Person
    pushed: list[str] = field(default_factory=list)
    tries: list[int] = field(default_factory=list)

    def work(self, over: threading.Event) -> None:
        number, dice = 0, random.Random(SEED)
        while not over.wait(dice.uniform(*PERSONS_PAUSE_S)):
            number += 1
            files = {f"notes/{number}.md": f"{number}\n"}
            if number % 5 == 0:  # a change after which all is rendered again
                images = "registry/images.yaml"
                files[images] = f"# change {number}\n{self.person.read(images)}"
            for attempt in range(1, 200):
                try:
                    self.pushed.append(self.person.push(files, f"Note {number}"))
                    self.tries.append(attempt)
                    break
                except AssertionError:
                    if over.is_set():
                        return


@pytest.mark.nightly
@pytest.mark.limit(LONGEST_TEST_S + DEMANDS)
def test_many_writers_end_where_one_would(
    drivers: Drivers,
    bare: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    lanes = [_lanes(who) for who in range(GENERATORS)]
    over, dice = threading.Event(), random.Random(SEED)

    def cuts() -> bool:
        return dice.random() < CUTS

    with git_over_http.serving(bare.parent) as server:
        person = _Person(rig.Person(bare, tmp_path / "person"))
        started = time.monotonic()
        runs = [
            drivers.start(
                f"{server.url}/{bare.name}",
                [[rig.demand(*one) for one in lane] for lane in each],
            )
            for each in lanes
        ]
        people = threading.Thread(target=person.work, args=(over,), daemon=True)
        people.start()
        try:
            told = rig.listen_to_all(drivers, runs, lambda: setattr(server.faults, "cuts", cuts))
        finally:
            over.set()
        took = time.monotonic() - started
        people.join(rig.PATIENCE_S)
        cut = server.cut
    with capsys.disabled():
        _print(told, person, took, cut)
    _assert_one_would_have_done_the_same(bare, lanes, told, person)
    assert cut, "no connection was cut, so the test has tested nothing"


def _assert_one_would_have_done_the_same(
    bare: Path, lanes: list[list[list[tuple[str, Goal]]]], told: list[rig.Told], person: _Person
) -> None:
    demands = [one for each in lanes for lane in each for one in lane]
    answers = {name: answer for one in told for name, answer in one.answers.items()}
    assert [a for a in answers.values() if a["outcome"] not in ("booked", "released")] == []
    assert [one.finished for one in told] == [True] * GENERATORS
    assert sorted(answers) == sorted(name for name, _ in demands)
    rig.assert_sound(bare, verify_last=20)
    assert sorted(rig.operations(bare)) == sorted(f"op-{name}" for name, _ in demands)
    assert rig.books(bare) == rig.books_after(made for _, made in demands)
    assert person.pushed
    there = rig.git(bare, "rev-list", "main").splitlines()
    assert {answer["commit"] for answer in answers.values()} | {*person.pushed} <= {*there}


def _print(told: list[rig.Told], person: _Person, took: float, cut: int) -> None:
    print(f"\n{DEMANDS} demands in {took:.1f} s ({DEMANDS / took:.0f} a second), {cut} cuts")
    start = min(one.first for one in told)
    for who, one in enumerate(told):
        waits = sorted(one.waits.values())
        print(
            f"  generator {who}: {len(waits)} answered, the last after {one.last - start:.1f} s; "
            f"median {statistics.median(waits):.2f} s, longest {waits[-1]:.2f} s"
        )
    print(f"  person: {len(person.pushed)} pushed, at most {max(person.tries)} tries for one")
