"""A rollback to an earlier ledger: which claims it books and releases, and when it is refused."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import timedelta
from random import Random

import pytest
from demandops.base.errors import Fault, Refused
from demandops.decide.booking import Restoration
from demandops.decide.decision import Decision, decide
from demandops.decide.state import State
from demandops.model.demand.demand import Lease
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import Ledger

from tests.kit.memory import NOW, MemoryRepo
from tests.model.goals import Maker

LATER = NOW + timedelta(hours=3)
LEASE = Lease(600, 30, NOW + timedelta(minutes=10))


def filled(seed: int) -> MemoryRepo:
    repo = MemoryRepo()
    for request in Maker(Random(seed), calm=True).sequence(12):
        repo.take(request)
    assert len(repo.state.ledger) > 2
    return repo


def with_ledger(repo: MemoryRepo, ledger: Ledger) -> State:
    return replace(repo.state, ledger=ledger)


def back_to(claims: Iterable[Claim], *, drop_newer: bool = False) -> Restoration:
    return Restoration(
        to="0" * 40, claims=tuple(claims), drop_newer=drop_newer, reason="r", by="A person"
    )


def rolled_back(repo: MemoryRepo, request: Restoration, state: State | None = None) -> Decision:
    return decide(state or repo.state, request, LATER, repo.files.get)


def refusal(repo: MemoryRepo, request: Restoration, state: State | None = None) -> list[Fault]:
    with pytest.raises(Refused) as refused:
        rolled_back(repo, request, state)
    return [*refused.value.faults]


@pytest.mark.parametrize("seed", range(3))
def test_books_and_files_are_what_they_were(seed: int) -> None:
    repo = filled(seed)
    then, files = repo.state.ledger, dict(repo.files)
    for request in Maker(Random(seed + 100)).sequence(12):
        repo.take(request)
    decision = rolled_back(repo, back_to(then, drop_newer=True))
    assert dict(decision.state.ledger.claims) == dict(then.claims)
    after = repo.files | decision.files
    assert {path: text for path, text in after.items() if text is not None} == files
    assert decision.outcome == ("restored" if decision.files else "unchanged")


def test_a_rollback_past_newer_or_changed_claims_is_refused_and_lists_them() -> None:
    repo = filled(0)
    *kept, newer = repo.state.ledger
    found = refusal(repo, back_to(kept))
    assert [(one.code, one.field) for one in found] == [("newer", ""), ("newer", "")]
    who, when = ", ".join(newer.requesters), f"{newer.booked:%Y-%m-%d %H:%M:%S} UTC"
    assert found[0].message == (
        f"would drop the claim of {who} on {newer.subject}, booked {when} "
        f"(request '{newer.request}')"
    )
    assert "--drop-newer" in found[1].message
    found = refusal(repo, back_to([*kept, replace(newer, request="another")]))
    assert "would undo a change of the claim of" in found[0].message


def test_a_lease_counts_anew_if_its_claim_comes_back_and_stays_if_it_was_renewed_since() -> None:
    repo = filled(0)
    first, *others = repo.state.ledger
    request = back_to([replace(first, lease=LEASE), *others])
    without = with_ledger(repo, repo.state.ledger.replace(first.key, None))
    anew = replace(first, lease=replace(LEASE, until=LATER + timedelta(minutes=10)))
    assert rolled_back(repo, request, without).state.ledger.get(first.key) == anew
    renewed = replace(first, lease=replace(LEASE, until=NOW + timedelta(minutes=50)))
    state = with_ledger(repo, repo.state.ledger.replace(first.key, renewed))
    decision = rolled_back(repo, request, state)
    assert (decision.outcome, dict(decision.files)) == ("unchanged", {})


def test_what_the_configuration_no_longer_has_is_refused() -> None:
    repo = filled(0)
    then = repo.state.ledger
    gone = next(claim for claim in then if claim.is_on_application)
    nodes = {id: node for id, node in repo.config.nodes.items() if id != gone.application.node}
    config = replace(repo.config, nodes=nodes)
    state = State(config, then.replace(gone.key, None), repo.state.evaluate)
    found = [one for one in refusal(repo, back_to(then), state) if one.field == "node"]
    assert found
    assert found[0].code == "unknown-node"
    assert found[0].file.startswith("ledger/applications/")
