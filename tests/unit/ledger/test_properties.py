"""Whatever is asked in whatever order: what must hold of the books and of what they render.

The model in ``tests/model`` knows the design and not the program; both take the same requests.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import timedelta
from random import Random

import pytest
from demandops.decision import Decision, State, rendered_files
from demandops.demand.claim import ClaimKey, demand_id
from demandops.errors import Refused
from demandops.ledger import claim_file
from hypothesis import assume, currently_in_test_context, given, note
from hypothesis import strategies as st

from tests.kit.chance import TIMES, chances, examples, told
from tests.kit.memory import NOW, MemoryRepo, outcome
from tests.model.books import Books, Demand, Goal, Result
from tests.model.goals import (
    SKELETON,
    STATION_CLOUD,
    VEHICLE_CLOUD,
    Maker,
    application,
    connection,
    ego,
    goal,
    shutdown_of,
    summary,
)
from tests.scenarios.running import ledger_in

Key = tuple[tuple[str, str], str]
"""A subject and a demand id."""

PAUSES = (1, 1, 1, 60, 400, 899, 900, 901)
"""Seconds between two requests; a shutdown is remembered for 900."""


def key_of(subject: tuple[str, str], demand: Demand) -> Key:
    """Return what the program knows a claim of the model by."""
    return subject, demand_id(*demand)


def key_in(key: ClaimKey) -> Key:
    """Return the key of a claim in plain words."""
    return (key.subject.kind.value.removesuffix("s"), key.subject.id), key.demand


def holds_in(repo: MemoryRepo) -> dict[Key, dict[tuple[str, ...], set[str]]]:
    """Return who holds which topic in each claim."""
    return {
        key_in(claim.key): {key: set(claim.holders(key)) for key in claim.held.topic_keys()}
        for claim in repo.state.ledger
    }


Taken = tuple[Goal, Result, Decision | Refused]


def taken_by_both(random: Random, length: int, repo: MemoryRepo, books: Books) -> Iterator[Taken]:
    """Have both take the same requests as time passes."""
    for request in Maker(random).sequence(length):
        pause = random.choice(PAUSES)
        if currently_in_test_context():
            note(f"{pause} s later: {json.dumps(summary(request))}")
        repo.now += timedelta(seconds=pause)
        yield request, books.take(request, pause), repo.take(request)


# As the model has it


@examples(45)
@given(chances, st.integers(1, 14))
def test_holds_bookkeeping_and_outcomes_are_the_models_after_every_request(
    random: Random, length: int
) -> None:
    repo, books = MemoryRepo(), Books(SKELETON)
    for _, expected, taken in taken_by_both(random, length, repo, books):
        assert outcome(taken) == expected.outcome, (expected, taken)
        assert holds_in(repo) == {key_of(*key): holds for key, holds in books.holds().items()}
        assert repo.view() == books.view()


@pytest.mark.parametrize("seed", range(2 * TIMES))
def test_bookkeeping_stays_the_models_over_a_long_time(seed: int) -> None:
    repo, books = MemoryRepo(), Books(SKELETON)
    for request, expected, taken in taken_by_both(Random(seed), 150, repo, books):
        assert outcome(taken) == expected.outcome, (request, expected, taken)
        assert repo.view() == books.view(), request


@examples(45)
@given(chances, st.integers(1, 14))
def test_a_shutdown_names_what_was_not_held_and_nothing_else(random: Random, length: int) -> None:
    repo, books = MemoryRepo(), Books(SKELETON)
    for _, expected, taken in taken_by_both(random, length, repo, books):
        if isinstance(taken, Refused) or expected.outcome == "refused":
            continue
        named = taken.changes.not_held
        assert all(any(_tells(text, one) for text in named) for one in expected.not_held), named
        assert all(any(_tells(text, one) for one in expected.not_held) for text in named), named


def _tells(text: str, in_vain: tuple[str, tuple[str, ...] | None, str]) -> bool:
    id_, topic, who = in_vain
    name = " ".join(("topic", topic[0]) if len(topic) == 1 else topic[:2]) if topic else ""
    about = f"'{id_}'" in text and text.endswith(f" for {who}")
    return about and (_whole(text) or f": {name} " in text)


def _whole(text: str) -> bool:
    """Tell whether a subject is named with no topic."""
    return ": " not in text


def test_a_subject_listed_twice_in_one_shutdown_costs_one_claim_only() -> None:
    who = ["vehicle00", "station00"]
    item = connection("station00/edge", who, ["/status"])
    repo = MemoryRepo()
    repo.take_all([goal("first", connections=[item]), goal("second", connections=[item])])
    whole = {**item, "source_topics": [], "target_topics": []}

    repo.take(goal("first", connections=[item, whole], shutdown=True))

    (left,) = repo.state.ledger
    assert left.request == "second"


def test_a_topic_that_a_shutdown_lists_twice_is_not_said_to_be_not_held() -> None:
    repo = MemoryRepo()
    topics = [ego("vehicle00"), ego("vehicle01")]
    repo.take(goal("one", [application("cloud/fusion", ["vehicle00"], topics)]))
    twice = [
        application("cloud/fusion", ["vehicle00"], topics[:1]),
        application("cloud/fusion", ["vehicle00"], topics),
    ]

    taken = repo.take(goal("one", twice, shutdown=True))

    assert isinstance(taken, Decision)
    assert taken.outcome == "released"
    assert taken.changes.not_held == ()


def test_a_shutdown_may_leave_out_the_ends_of_a_connection() -> None:
    repo = MemoryRepo()
    joined = connection("station00/edge", ["station00"], ["/status"])
    repo.take(goal("one", connections=[joined]))
    bare = {**joined, "source_node_id": "", "target_node_id": ""}

    taken = repo.take(goal("one", connections=[bare], shutdown=True))

    assert outcome(taken) == "released", taken


# Nothing stays behind


@examples(20)
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
    outcomes = [outcome(without.take(request)) for request in first]

    assert [outcome(with_guest.take(request)) for request in first] == outcomes
    came = outcome(with_guest.take(guest))
    assert [outcome(with_guest.take(request)) for request in others] == [
        outcome(without.take(request)) for request in others
    ]
    left = outcome(with_guest.take(shutdown_of(guest)))

    assert (came, left) in (("booked", "released"), ("refused", "refused"))
    with_guest.forget_shutdowns()
    without.forget_shutdowns()
    assert with_guest.state == without.state
    assert with_guest.files == without.files


@examples(20)
@given(chances, st.integers(1, 8))
def test_when_all_have_left_the_repo_is_as_it_was_laid_down(random: Random, count: int) -> None:
    maker, repo = Maker(random, calm=True), MemoryRepo()
    requests = told([maker.join(f"request {number}") for number in range(count)])
    repo.take_all(requests)

    assert set(repo.take_all([shutdown_of(request) for request in requests])) == {"released"}
    repo.forget_shutdowns()
    assert repo.state == MemoryRepo().state
    assert repo.files == MemoryRepo().files


# Again


@examples(28)
@given(chances, st.integers(1, 8))
def test_booking_again_changes_nothing(random: Random, length: int) -> None:
    maker, repo = Maker(random), MemoryRepo()
    for request in told(maker.sequence(length)):
        taken = repo.take(request)
        if outcome(taken) not in ("booked", "unchanged"):
            continue
        reworded = maker.again(request)
        note(f"again: {json.dumps(summary(reworded))}")
        for same in (request, reworded):
            again = repo.decide(same, NOW + timedelta(days=1))
            assert again.outcome == "unchanged"
            assert again.state == repo.state
            assert not again.files
            assert not again.changes.claims
            assert not again.releases


@examples(28)
@given(chances, st.integers(0, 6))
def test_a_demand_still_counts_once_when_others_came_in_between(
    random: Random, others: int
) -> None:
    maker, repo = Maker(random, calm=True), MemoryRepo()
    request = maker.join("mine")
    repo.take_all(told([request, *(maker.join() for _ in range(others))]))

    assert repo.decide(maker.again(request)).outcome == "unchanged"


# Together or not at all


@examples(35)
@given(chances, st.integers(0, 6))
def test_what_a_request_asks_for_is_booked_together_or_not_at_all(
    random: Random, before: int
) -> None:
    maker, repo = Maker(random), MemoryRepo()
    repo.take_all(told(maker.sequence(before)))
    request = told([maker.join()])[0]
    parts = [goal(request["id"], [app]) for app in request["apps"]]
    parts += [goal(request["id"], connections=[item]) for item in request["connections"]]
    one_by_one = MemoryRepo()
    one_by_one.state, one_by_one.files = repo.state, dict(repo.files)
    outcomes = [outcome(one_by_one.take(part)) for part in parts]
    standing, files = repo.state, dict(repo.files)

    taken = repo.take(request)

    if not parts or "refused" in outcomes:
        assert isinstance(taken, Refused), outcomes
        assert (repo.state, repo.files) == (standing, files)
    else:
        assert outcome(taken) == ("booked" if "booked" in outcomes else "unchanged")
        assert repo.state == one_by_one.state
        assert repo.files == one_by_one.files


@examples(28)
@given(chances, st.integers(1, 12))
def test_a_request_writes_the_claims_it_changes_and_no_others(random: Random, length: int) -> None:
    repo, books = MemoryRepo(), Books(SKELETON)
    for _, expected, taken in taken_by_both(random, length, repo, books):
        if isinstance(taken, Refused):
            continue
        changed = {key_in(change.key) for change in taken.changes.claims}
        assert changed == {key_of(*key) for key in expected.touched}
        paths = {claim_file.path_of(change.key) for change in taken.changes.claims}
        assert {path for path in taken.files if claim_file.kind_of(path)} == paths
        assert bool(taken.files) == expected.effective


def test_a_contradiction_in_a_connection_keeps_the_application_from_being_booked() -> None:
    repo = MemoryRepo()
    mine = connection("vehicle00/edge", ["vehicle00"])
    repo.take(goal("one", connections=[mine]))
    standing = repo.state
    other = {**mine, "target_node_id": "cloud", "requester_ids": ["station00"]}
    app = application("edge/object_detection_fusion", ["station00"], clouds=[STATION_CLOUD])

    taken = repo.take(goal("two", [app], [other]))

    assert isinstance(taken, Refused)
    assert repo.state == standing


# Order


@examples(14)
@given(chances, st.integers(2, 6))
def test_the_order_of_independent_demands_does_not_matter(random: Random, count: int) -> None:
    maker = Maker(random, calm=True)
    joins = [maker.join(f"request {number}") for number in range(count)]
    leaves = [shutdown_of(request) for request in joins[: random.randrange(count)]]
    one_order = told([*joins, *leaves, *(maker.join() for _ in range(count))])
    other_order: list[Goal] = []
    waiting = random.sample(one_order, len(one_order))
    while waiting:  # who leaves has joined before
        here = {request["id"] for request in other_order}
        ready = [r for r in waiting if not r["shutdown"] or r["id"] in here]
        other_order.append(ready[0])
        waiting.remove(ready[0])
    one, other = MemoryRepo(), MemoryRepo()

    assert "refused" not in {outcome(one.take(request)) for request in one_order}
    for request in other_order:  # nor does it matter in which order a request lists things
        assert outcome(other.take(maker.again(request))) != "refused"
    one.forget_shutdowns()
    other.forget_shutdowns()
    assert one.state == other.state
    assert one.files == other.files


# Step by step


@examples(28)
@given(chances, st.integers(1, 12))
def test_rendering_step_by_step_gives_what_rendering_at_once_gives(
    random: Random, length: int
) -> None:
    repo = MemoryRepo()
    for request in told(Maker(random).sequence(length)):
        repo.take(request)
        at_once = rendered_files(repo.state)
        assert repo.below(*{path.split("/")[0] for path in at_once}) == at_once
        fresh = State.of(repo.state.config, ledger_in(repo.files))
        assert fresh.ledger == repo.state.ledger
    assert rendered_files(fresh) == at_once


@examples(28)
@given(chances, st.integers(1, 8))
def test_a_further_requester_changes_no_release(random: Random, length: int) -> None:
    maker, repo = Maker(random), MemoryRepo()
    requests = told(maker.sequence(length))
    taken = [repo.take(request) for request in requests]
    standing = [
        request
        for request, decision in zip(requests, taken, strict=True)
        if outcome(decision) == "booked"
    ]
    assume(standing)
    same = maker.again(standing[-1])
    for app in same["apps"]:
        app["object_detection_fusion_app"]["requester_ids"].append("onlooker")
    for item in same["connections"]:
        item["requester_ids"].append("onlooker")
    told([same])
    assume(outcome(repo.take(standing[-1])) == "unchanged")

    decision = repo.take(same)

    assert outcome(decision) == "booked"
    assert isinstance(decision, Decision)
    assert not decision.releases
    assert not [path for path in decision.files if not path.startswith("ledger/")]


def test_the_model_and_the_program_agree_on_the_papers_table() -> None:
    repo, books = MemoryRepo(), Books(SKELETON)
    joins = []
    for vehicle in ("vehicle00", "vehicle01", "vehicle03", "vehicle02"):
        who = [vehicle, "station00"]
        clouds = [STATION_CLOUD, *([VEHICLE_CLOUD] if vehicle == "vehicle00" else [])]
        app = application("edge/object_detection_fusion", who, [ego(vehicle)], clouds)
        joins.append(goal("intersection", [app], [connection("station00/edge", who)]))
    for request in [*joins, *map(shutdown_of, joins)]:
        assert outcome(repo.take(request)) == books.take(request).outcome != "refused"
        assert repo.view() == books.view()
    assert not books.claims
