"""The lease of a demand that awaits approval; ``tests/scenarios`` has who asks for approval."""

from __future__ import annotations

from dataclasses import replace

from demandops.model.demand.demand import UNSTARTED
from demandops.model.ledger import claim as claim_files

from tests.kit.goals import put
from tests.kit.memory import NOW, MemoryRepo


def test_a_proposed_lease_has_no_end_and_is_written_without() -> None:
    books = MemoryRepo()
    decision = books.decide(put("d", lease=60))
    ledger = books.decide(replace(decision.request, awaits_approval=True)).state.ledger
    claims = ledger.claims_with("demand", "d")
    claim = next(one for one in claims if one.is_on_application)
    assert claim.lease is not None
    assert claim.lease.until == UNSTARTED
    assert not claim.lease.has_started
    text = claim_files.text_of(claim)
    assert "until" not in text
    assert claim_files.read(text, claim_files.path_of(claim.key)) == claim
    assert {one.key for one in ledger.unstarted_claims()} == {one.key for one in claims}
    later = claim.lease.started(NOW)
    assert (later.seconds, (later.until - NOW).total_seconds()) == (60, 60)
    assert ledger.ended_claims(NOW.replace(year=2100)) == ()
