"""A traced plan follows the changes of the ledger, and always equals a plan computed anew."""

from __future__ import annotations

from dataclasses import replace
from random import Random

from demandops.decide.decision import Decision
from demandops.decide.planning.planner import TracedPlan, plan
from demandops.decide.planning.release_keys import ReleaseKey, all_keys
from demandops.model.config.config import Config
from demandops.model.ledger.ledger import ClaimChange, Ledger, World
from demandops.model.release import Release
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples, told
from tests.kit.memory import MemoryRepo
from tests.model.goals import Maker


def afresh(world: World) -> dict[ReleaseKey, Release]:
    plans = {key: plan(world, key) for key in all_keys(world)}
    return {key: release for key, release in plans.items() if release}


class Following:
    """The releases after each step: a traced plan returns changes, and this class applies them."""

    def __init__(self, config: Config) -> None:
        self._plan = TracedPlan(config)
        self.releases: dict[ReleaseKey, Release] = {}

    def take(self, ledger: Ledger, changes: tuple[ClaimChange, ...]) -> int:
        found = self._plan.advance(ledger, changes)
        for key, release in found.items():
            self.releases.pop(key, None)
            if release is not None:
                self.releases[key] = release
        return len(found)


@examples(20)
@given(chances, st.integers(1, 20))
def test_a_plan_traced_through_changes_equals_a_fresh_plan(random: Random, length: int) -> None:
    """The traced plan gets the changes of one request, or of several requests at once."""
    repo = MemoryRepo()
    following = Following(repo.config)
    changes: list[ClaimChange] = []
    for request in told(Maker(random).sequence(length)):
        taken = repo.take(request)
        if isinstance(taken, Decision):
            changes += taken.changes.claims
        if random.random() < 0.5:
            following.take(repo.state.ledger, tuple(changes))
            changes.clear()
            assert following.releases == afresh(repo.state)


def test_what_reads_nothing_that_changed_is_left_alone() -> None:
    repo = MemoryRepo()
    repo.take_all(Maker(Random(1), calm=True).sequence(20))
    following, ledger = Following(repo.config), repo.state.ledger
    everything = following.take(ledger, ())
    assert everything == len(all_keys(repo.state)) > 4
    claim = next(claim for claim in ledger if not claim.is_on_application)
    without = ledger.replace(claim.key, None)
    assert 0 < following.take(without, (ClaimChange(claim, None),)) < everything
    assert following.releases == afresh(replace(repo.state, ledger=without))
    assert following.take(without, ()) == 0
