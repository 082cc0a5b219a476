"""Properties that the ledger and the rendered files have after any requests in any order.

Program and model take the same requests. The model in ``tests/model`` follows the design and uses
no code of the program.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from random import Random

from demandops.decide.booking import Restoration
from demandops.decide.decision import Decision
from demandops.decide.state import rendered_files
from demandops.model.ledger import claim as claim_files
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples, told
from tests.kit.memory import MemoryRepo, ledger_in, outcome
from tests.model.books import Books, Result
from tests.model.goals import SKELETON, Maker, shutdown_of
from tests.model.listed import Goal, Topic
from tests.model.view import (
    claims_in_ledger,
    claims_of,
    in_model_words,
    key_in_ledger,
    key_of,
    view,
)


class Walk:
    """A repo and the model, which take the same requests and are compared after each."""

    def __init__(self, random: Random) -> None:
        self.maker = Maker(random, both=True)
        self._repo, self._books = MemoryRepo(), Books(SKELETON)

    def take(self, request: Goal) -> None:
        self._repo.now += timedelta(seconds=1)
        expected = self._books.take(request)
        taken = self._repo.take(request)
        assert outcome(taken) == expected.outcome, (expected, taken)
        assert claims_in_ledger(self._repo.state.ledger) == claims_of(self._books), request
        assert in_model_words(self._repo.bookkeeping()) == view(self._books)
        if isinstance(taken, Decision):
            assert_changes(taken, expected)
            self._assert_counts_once(request)

    def assert_rendered_from_the_files(self) -> None:
        """Check that the ledger's files alone give the rendered files that the requests gave."""
        fresh = replace(self._repo.state, ledger=ledger_in(self._repo.files))
        assert fresh.ledger == self._repo.state.ledger
        at_once = rendered_files(fresh)
        assert self._repo.below(*{path.split("/")[0] for path in at_once}) == at_once

    def _assert_counts_once(self, request: Goal) -> None:
        again = request if "kind" in request else self.maker.again(request)
        repo = self._repo.copy()
        repo.now += timedelta(days=365)
        gives_up = request.get("shutdown") or request.get("operation") == "release"
        assert outcome(repo.take(again)) == ("refused" if gives_up else "unchanged"), again
        assert (repo.files, repo.state) == (self._repo.files, self._repo.state)


def assert_changes(taken: Decision, expected: Result) -> None:
    """Check that exactly the touched claims are written, and that each missing hold is named."""
    changed = {key_in_ledger(change.key) for change in taken.changes.claims}
    assert changed == {key_of(key) for key in expected.touched}
    paths = {claim_files.path_of(change.key) for change in taken.changes.claims}
    assert {path for path in taken.files if claim_files.kind_of(path)} == paths
    assert bool(taken.files) == bool(expected.touched)
    named = taken.changes.not_held
    for vain in expected.not_held:
        assert any(_names(text, *vain) for text in named), (vain, named)
    for text in named:
        assert any(_names(text, *vain) for vain in expected.not_held), (text, expected.not_held)


def _names(text: str, subject: str, topic: Topic | None, who: tuple[str, ...]) -> bool:
    """Return whether a text names a subject and its requesters, and ``topic`` if there is one."""
    words = " ".join(("topic", *topic) if len(topic) == 1 else topic[:2]) if topic else ""
    named = f": {words} " in text if topic else ": " not in text
    return named and f"'{subject}'" in text and text.endswith(f" for {', '.join(who)}")


@examples(25)
@given(chances, st.integers(1, 14))
def test_bookkeeping_files_and_outcomes_are_the_models_after_every_request(
    random: Random, length: int
) -> None:
    walk = Walk(random)
    for request in told(walk.maker.sequence(length)):
        walk.take(request)
    walk.assert_rendered_from_the_files()


def often(requests: list[Goal], random: Random) -> list[Goal]:
    """Return each request once to three times, in any order."""
    repeated = [request for request in requests for _ in range(random.randint(1, 3))]
    return random.sample(repeated, len(repeated))


@examples(10)
@given(chances, st.integers(1, 8))
def test_when_all_have_left_the_repo_is_as_it_was_laid_down(random: Random, count: int) -> None:
    maker, repo = Maker(random, calm=True), MemoryRepo()
    requests = told([maker.join(f"request {number}") for number in range(count)])
    repo.take_all(often(requests, random))
    ends = often([shutdown_of(request) for request in requests], random)
    assert {*repo.take_all(ends)} <= {"released", "refused"}, "who has left may say so again"
    assert (repo.state, repo.files) == (MemoryRepo().state, MemoryRepo().files)


@examples(9)
@given(chances, st.integers(0, 12), st.integers(0, 12))
def test_a_rollback_gives_the_books_and_files_of_then(
    random: Random, before: int, after: int
) -> None:
    repo = MemoryRepo()
    repo.take_all(told(Maker(random, calm=True).sequence(before)))
    then, files = repo.state.ledger, dict(repo.files)
    repo.take_all(told(Maker(random).sequence(after)))
    back = Restoration(id="back", to="0" * 40, claims=tuple(then), drop_newer=True)
    decision = repo.send(back)
    assert (repo.state.ledger.claims, repo.files) == (then.claims, files)
    assert decision.outcome == ("restored" if decision.files else "unchanged")
