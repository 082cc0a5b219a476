"""A rollback to an earlier ledger: which claims it books and releases, and when it is refused."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime, timedelta
from random import Random
from typing import Any

import pytest
from demandops.base.errors import Refused
from demandops.decide.decision import Decision, decide
from demandops.decide.restoration import Restoration
from demandops.decide.state import State
from demandops.model.config.config import Config
from demandops.model.demand.claim import Claim, Lease
from demandops.model.ledger.ledger import Ledger

from tests.kit.memory import NOW, MemoryRepo
from tests.model.goals import Maker

LATER = NOW + timedelta(hours=3)


def back_to(claims: Iterable[Claim], *, drop_newer: bool = False) -> Restoration:
    return Restoration(
        id="",
        to="0" * 40,
        claims=tuple(claims),
        drop_newer=drop_newer,
        reason="r",
        by="A person",
    )


def filled(seed: int) -> MemoryRepo:
    repo = MemoryRepo()
    for request in Maker(Random(seed), calm=True).sequence(12):
        repo.take(request)
    assert len(repo.state.ledger) > 2
    return repo


def claims(ledger: Ledger) -> dict[Any, Claim]:
    return {claim.key: claim for claim in ledger}


def rolled_back(repo: MemoryRepo, request: Restoration, now: datetime = LATER) -> Decision:
    return decide(repo.state, request, now, repo.files.get)


@pytest.mark.parametrize("seed", range(3))
def test_books_and_files_are_what_they_were(seed: int) -> None:
    repo = filled(seed)
    repo.forget_shutdowns()
    then, files = repo.state.ledger, dict(repo.files)
    for request in Maker(Random(seed + 100)).sequence(12):
        repo.take(request)
    repo.forget_shutdowns()
    decision = rolled_back(repo, back_to(then, drop_newer=True))
    assert claims(decision.state.ledger) == claims(then)
    after = repo.files | decision.files
    assert {path: text for path, text in after.items() if text is not None} == files
    assert decision.outcome == ("restored" if decision.files else "unchanged")


def test_a_rollback_past_newer_claims_is_refused_and_lists_them() -> None:
    repo = filled(0)
    kept = list(repo.state.ledger)
    newer = kept.pop()
    with pytest.raises(Refused) as told:
        rolled_back(repo, back_to(kept))
    assert [(one.code, one.field) for one in told.value.faults] == [("newer", ""), ("newer", "")]
    who = ", ".join(newer.requesters)
    assert told.value.faults[0].message == (
        f"would drop the claim of {who} on {newer.subject}, booked "
        f"{newer.booked:%Y-%m-%d %H:%M:%S} UTC (request '{newer.request}')"
    )
    assert told.value.faults[1].message == (
        "claims that were booked or changed since are undone only with --drop-newer"
    )


def test_a_claim_changed_since_counts_as_newer() -> None:
    repo = filled(0)
    first, *others = repo.state.ledger
    with pytest.raises(Refused) as told:
        rolled_back(repo, back_to([replace(first, request="another"), *others]))
    assert "would undo a change of the claim of" in told.value.faults[0].message


def test_a_claim_that_comes_back_has_its_lease_from_now_on() -> None:
    repo = filled(0)
    first, *others = repo.state.ledger
    leased = replace(first, lease=Lease(600, 30, NOW + timedelta(minutes=10)))
    repo.state = replace(repo.state, ledger=repo.state.ledger.replace(first.key, None))
    decision = rolled_back(repo, back_to([leased, *others]))
    back = decision.state.ledger.get(first.key)
    assert back == replace(leased, lease=Lease(600, 30, LATER + timedelta(minutes=10)))


def test_a_lease_renewed_since_stays_as_it_is() -> None:
    repo = filled(0)
    first, *others = repo.state.ledger
    leased = replace(first, lease=Lease(600, 30, NOW + timedelta(minutes=10)))
    renewed = replace(first, lease=Lease(600, 30, NOW + timedelta(minutes=50)))
    repo.state = replace(repo.state, ledger=repo.state.ledger.replace(first.key, renewed))
    decision = rolled_back(repo, back_to([leased, *others]))
    assert (decision.outcome, dict(decision.files)) == ("unchanged", {})


def test_what_the_configuration_no_longer_has_is_refused() -> None:
    repo = filled(0)
    then = repo.state.ledger
    application = next(c for c in then if c.subject.kind.value == "applications")
    ledger = then.replace(application.key, None)
    config = _without_node(repo.state.config, application.application.node)
    state = State(config, ledger, repo.state.evaluate)
    with pytest.raises(Refused) as told:
        decide(state, back_to(then), LATER, repo.files.get)
    found = [one for one in told.value.faults if one.field == "node"]
    assert found
    assert found[0].code == "unknown-node"
    assert found[0].file.startswith("ledger/applications/")


def _without_node(config: Config, node: str) -> Config:
    nodes = {name: known for name, known in config.nodes.items() if name != node}
    return replace(config, nodes=nodes)
