"""Properties that the ledger and the rendered files have after any requests in any order.

Program and model take the same requests. The model in ``tests/model`` follows the design and uses
no code of the program.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from random import Random

import pytest
from demandops.decide.decision import Decision
from demandops.decide.state import rendered_files
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import ClaimKey, demand_id
from demandops.model.ledger.records import SHUTDOWNS_ROOT
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.kit.chance import IN_FULL, TIMES, chances, examples, told
from tests.kit.goals import application, connection, goal, link
from tests.kit.memory import MemoryRepo, ledger_in, outcome
from tests.model.books import Books, Demand, Goal, Result
from tests.model.goals import SKELETON, Maker, ego, shutdown_of

PAUSES = (1, 1, 1, 60, 400, 899, 900, 901)
"""Seconds between two requests; the ledger remembers a shutdown for 900 seconds."""

Key = tuple[tuple[str, str], str]
"""A claim's key: its subject and its demand id."""


def key_of(subject: tuple[str, str], demand: Demand) -> Key:
    """Return the key that the program's claim must have for a claim of the model."""
    return subject, demand_id(*demand)


def key_from(key: ClaimKey) -> Key:
    """Convert the program's key of a claim."""
    return (key.subject.kind.value.removesuffix("s"), key.subject.id), key.demand


class Walk:
    """A repo and the model, which take the same requests and are compared after each."""

    def __init__(self, random: Random) -> None:
        self.maker = Maker(random)
        self._random = random
        self._repo, self._books = MemoryRepo(), Books(SKELETON)

    def take(self, request: Goal) -> None:
        pause = self._random.choice(PAUSES)
        self._repo.now += timedelta(seconds=pause)
        expected = self._books.take(request, pause)
        taken = self._repo.take(request)
        assert outcome(taken) == expected.outcome, (pause, expected, taken)
        holds = {key_of(*key): holds for key, holds in self._books.holds().items()}
        assert self._holds() == holds, (pause, request)
        assert self._repo.view() == self._books.view()
        if isinstance(taken, Decision):
            assert_changes(taken, expected)
            if not request["shutdown"]:
                self._assert_counts_once(request)

    def assert_rendered_from_the_files(self) -> None:
        """Check that the ledger's files alone give the rendered files that the requests gave."""
        fresh = replace(self._repo.state, ledger=ledger_in(self._repo.files))
        assert fresh.ledger == self._repo.state.ledger
        at_once = rendered_files(fresh)
        assert self._repo.below(*{path.split("/")[0] for path in at_once}) == at_once

    def _holds(self) -> dict[Key, dict[tuple[str, ...], set[str]]]:
        return {
            key_from(claim.key): {key: set(claim.holders(key)) for key in claim.held.topic_keys()}
            for claim in self._repo.state.ledger
        }

    def _assert_counts_once(self, request: Goal) -> None:
        same = self.maker.again(request)
        again = self._repo.decide(same, self._repo.now + timedelta(days=1))
        assert again.outcome == "unchanged", same
        assert again.state == self._repo.state
        assert (dict(again.files), again.changes.claims, again.releases) == ({}, (), ())


def assert_changes(taken: Decision, expected: Result) -> None:
    """Check that exactly the touched claims are written, and that each missing hold is named."""
    changed = {key_from(change.key) for change in taken.changes.claims}
    assert changed == {key_of(*key) for key in expected.touched}
    paths = {claim_files.path_of(change.key) for change in taken.changes.claims}
    assert {path for path in taken.files if claim_files.kind_of(path)} == paths
    assert bool(taken.files) == expected.effective
    named = taken.changes.not_held
    for vain in expected.not_held:
        assert any(_names(text, *vain) for text in named), (vain, named)
    for text in named:
        assert any(_names(text, *vain) for vain in expected.not_held), (text, expected.not_held)


def _names(text: str, subject: str, topic: tuple[str, ...] | None, who: str) -> bool:
    """Return whether a text names a subject and a requester, and no topic other than ``topic``."""
    words = " ".join(("topic", *topic) if len(topic) == 1 else topic[:2]) if topic else ""
    named = ": " not in text or f": {words} " in text
    return named and f"'{subject}'" in text and text.endswith(f" for {who}")


def assert_same(one: MemoryRepo, other: MemoryRepo) -> None:
    """Check that two repos are the same but for the shutdowns that they remember."""
    one.forget_shutdowns()
    other.forget_shutdowns()
    assert one.state == other.state
    assert one.files == other.files


@examples(25)
@given(chances, st.integers(1, 14))
def test_bookkeeping_files_and_outcomes_are_the_models_after_every_request(
    random: Random, length: int
) -> None:
    walk = Walk(random)
    for request in told(walk.maker.sequence(length)):
        walk.take(request)
    walk.assert_rendered_from_the_files()


@pytest.mark.parametrize("seed", range(2 * TIMES if IN_FULL else 1))
def test_they_stay_the_models_over_a_long_time(seed: int) -> None:
    walk = Walk(Random(seed))
    for request in walk.maker.sequence(120):
        walk.take(request)
    walk.assert_rendered_from_the_files()


def test_a_repeat_that_waited_in_a_journal_is_a_repeat_when_others_were_booked_meanwhile() -> None:
    repo = MemoryRepo()
    repo.send(goal([], [connection()], id="a"))
    repo.send(goal([], [connection()], id="b"))
    ends = goal([], [connection()], id="a", shutdown=True)
    repo.send(ends)
    repo.send(link(0), repo.now + timedelta(minutes=50))
    assert repo.decide(ends, repo.now + timedelta(minutes=10)).outcome == "unchanged"
    repo.send(link(1), repo.now + timedelta(minutes=62))
    assert not repo.state.ledger.shutdowns.by_digest
    assert not any(path.startswith(SHUTDOWNS_ROOT) for path in repo.files)


def test_a_topic_that_a_shutdown_lists_twice_is_not_said_to_be_not_held() -> None:
    repo = MemoryRepo()
    both, first = (
        application("cloud/fusion", node="cloud", ego=map(ego, vehicles), clouds=[])
        for vehicles in (["vehicle00", "vehicle01"], ["vehicle00"])
    )
    repo.send(goal([both]))
    assert repo.send(goal([first, both], shutdown=True)).changes.not_held == ()


@examples(10)
@given(chances, st.integers(0, 6), st.integers(0, 6))
def test_a_released_demand_leaves_no_trace(random: Random, before: int, after: int) -> None:
    maker = Maker(random)
    first = maker.sequence(before)
    maker.calm = True
    guest = Maker(random, calm=True).join("guest", ["visitor"])
    others = [
        maker.leave() if maker.joined and random.randrange(2) else maker.join()
        for _ in range(after)
    ]
    told([*first, guest, *others])
    with_guest, without = MemoryRepo(), MemoryRepo()

    assert with_guest.take_all(first) == without.take_all(first)
    (came,) = with_guest.take_all([guest])
    assert with_guest.take_all(others) == without.take_all(others)
    (left,) = with_guest.take_all([shutdown_of(guest)])

    assert (came, left) in (("booked", "released"), ("refused", "refused"))
    assert_same(with_guest, without)


@examples(10)
@given(chances, st.integers(1, 8))
def test_when_all_have_left_the_repo_is_as_it_was_laid_down(random: Random, count: int) -> None:
    maker, repo = Maker(random, calm=True), MemoryRepo()
    requests = told([maker.join(f"request {number}") for number in range(count)])
    repo.take_all(requests)

    assert set(repo.take_all([shutdown_of(request) for request in requests])) == {"released"}
    assert_same(repo, MemoryRepo())


@examples(8)
@given(chances, st.integers(2, 6))
def test_the_order_of_independent_demands_does_not_matter(random: Random, count: int) -> None:
    maker = Maker(random, calm=True)
    joins = [maker.join(f"request {number}") for number in range(count)]
    leaves = [shutdown_of(request) for request in joins[: random.randrange(count)]]
    one_order = told([*joins, *leaves, *(maker.join() for _ in range(count))])
    other_order: list[Goal] = []
    waiting = random.sample(one_order, len(one_order))
    while waiting:  # a shutdown must come after its join
        here = {request["id"] for request in other_order}
        ready = [r for r in waiting if not r["shutdown"] or r["id"] in here]
        other_order.append(ready[0])
        waiting.remove(ready[0])
    one, other = MemoryRepo(), MemoryRepo()

    assert "refused" not in {outcome(one.take(request)) for request in one_order}
    for request in other_order:  # the order inside a request does not matter either
        assert outcome(other.take(maker.again(request))) != "refused"
    assert_same(one, other)


@examples(14)
@given(chances, st.integers(1, 8))
def test_a_further_requester_changes_no_release(random: Random, length: int) -> None:
    maker, repo = Maker(random), MemoryRepo()
    requests = told(maker.sequence(length))
    standing = [request for request in requests if outcome(repo.take(request)) == "booked"]
    assume(standing)
    same = maker.again(standing[-1])
    for app in same["apps"]:
        app["object_detection_fusion_app"]["requester_ids"].append("onlooker")
    for item in same["connections"]:
        item["requester_ids"].append("onlooker")
    told([same])
    assume(outcome(repo.take(standing[-1])) == "unchanged")

    decision = repo.send(same)

    assert decision.outcome == "booked"
    assert not decision.releases
    assert not [path for path in decision.files if not path.startswith("ledger/")]
