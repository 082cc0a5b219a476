"""Demands are put, renewed and released, and expire, in any order and with restarts.

``tests/model/leases.py``, a model of the promises that leases make, must allow each result.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from random import Random
from typing import Any

from demandops.decide.decision import Decision
from demandops.model.config.load import load
from demandops.model.ledger import claim_file
from demandops.model.ledger.ledger import Ledger
from demandops.model.ledger.records import RecentShutdowns
from hypothesis import given, note
from hypothesis import strategies as st

from tests.kit.chance import chances, examples
from tests.kit.config import state_of
from tests.kit.memory import ledger_in
from tests.kit.promises import Maker, claims_of, name_of
from tests.model.leases import Promises
from tests.scenarios import running

SLACK_S = 30
DOMAIN = {
    "name": "perception",
    "namespace": "perception",
    "nodes": ["*"],
    "leases": {"slack": f"{SLACK_S}s"},
}
FILES = running.configuration((), {"policy/access-domains.yaml": {"domains": [DOMAIN]}})
EMPTY = state_of(load(FILES))
PAUSES = (1, 1, 2, 5, 10, 11, 29, 30, 31, 59, 60, 61, 90, 91, 121, 900, 3600)


def restart(world: running.World, random: Random) -> None:
    """Restart the generator, and let it read the ledger's files in random order."""
    files = random.sample(sorted(world.files.items()), len(world.files))
    ledger = ledger_in(dict(files))
    assert ledger == world.state.ledger
    world.state = replace(world.state, ledger=ledger)
    world.restart()


def assert_released(world: running.World, promises: Promises, now: int) -> None:
    """Release the expired demands.

    Check that each claim that must end is released, and that each released claim may end.
    """
    before = set(claims_of(world.state.ledger))
    demands = world.do_what_is_due()
    assert len(demands) == len(set(demands))
    released = before - set(claims_of(world.state.ledger))
    assert promises.must_go(now) <= released <= promises.may_go(now)
    assert {demand for demand, _ in released} == set(demands)
    promises.gone(released)


def assert_outcome(taken: Any, expected: str, promises: Promises) -> None:
    outcome = taken.outcome if isinstance(taken, Decision) else "refused"
    if (outcome, expected) == ("booked", "unchanged"):
        assert taken.releases == ()
        for change in taken.changes.claims:  # only the recorded time changes
            assert change.before.lease != change.after.lease
            assert change.before.booked == change.after.booked
    else:
        assert outcome == expected, taken


def assert_recorded(world: running.World, promises: Promises) -> None:
    """Check the recorded end of each lease against the promised end.

    The recorded end must not be later than the promised end, nor earlier by more than the slack.
    """
    for claim in world.state.ledger:
        demand, subject = name_of(claim)
        promised = promises.held[demand][subject].promised
        assert (claim.lease is None) == (promised is None)
        if claim.lease is not None and promised is not None:
            end = running.START + timedelta(seconds=promised)
            assert claim.lease.until <= end <= claim.lease.expires_at


@examples(30)
@given(chances, st.integers(1, 16))
def test_every_result_agrees_with_the_model_of_lease_promises(random: Random, length: int) -> None:
    world, promises, maker = running.World(EMPTY, FILES), Promises(SLACK_S), Maker(random)
    now = 0
    for _ in range(length):
        pause = random.choice(PAUSES)
        now += pause
        world.clock.pass_(pause)
        if not random.randrange(4):
            restart(world, random)
        note(f"at {now}:")
        assert_released(world, promises, now)
        goal = maker.any()
        note(repr(goal))
        expected = promises.take(goal, now)
        taken = world.take(goal)
        assert_outcome(taken, expected, promises)
        assert claims_of(world.state.ledger) == promises.claims()
        assert_recorded(world, promises)
        if isinstance(taken, Decision) and taken.request.adds_claims:
            again = world.take(goal)
            assert isinstance(again, Decision)
            assert (again.outcome, dict(again.files)) == ("unchanged", {})
    world.assert_sound()
    leave_all(world, promises, now)


def leave_all(world: running.World, promises: Promises, now: int) -> None:
    """Let every lease end and release the other demands; check that nothing is left."""
    world.clock.pass_(2 * 3600)
    assert_released(world, promises, now + 2 * 3600)
    for claim in list(world.state.ledger):
        if world.state.ledger.get(claim.key) is None:
            continue  # released already, with another claim of the same demand
        release = {"kind": "Demand", "operation": "release", "demand": claim.demand}
        world.take(release | {"requesters": list(claim.requesters)})
    assert replace(world.state.ledger, shutdowns=RecentShutdowns()) == Ledger()
    assert world.rendered() == {}
    assert not [path for path in world.files if claim_file.kind_of(path)]
