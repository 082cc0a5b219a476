"""Access domains, their rules and application definitions can require approval of demands."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from demandops.model.config.load import load
from demandops.model.demand.demand import UNSTARTED
from demandops.model.ledger import claim as claim_files

from tests.kit import plain_yaml
from tests.kit.config import state_of
from tests.kit.goals import EGO, Goal, application, connection, goal, perception, put
from tests.kit.memory import NOW, MemoryRepo
from tests.scenarios.running import configuration

DOMAIN = "access domain 'perception'"
RULE = f"rule 'asks' of {DOMAIN}"
ASKS = {"name": "asks", "approval": "required"}
VEHICLES = {"name": "vehicles", "requesters": ["vehicle*"], "approval": "none"}


def repo_with(
    *more: dict[str, Any], appdef: dict[str, Any] | None = None, **domain: Any
) -> MemoryRepo:
    """Return a repo with fields of its domain and its definition changed, and with more domains."""
    domains = [{"name": "perception", "namespace": "perception"} | domain, *more]
    changed = {
        "policy/access-domains.yaml": {"domains": domains},
        "appdefs/object-detection-fusion/appdef.yaml": appdef or {},
    }
    return MemoryRepo(state=state_of(load(configuration(config=changed))))


CASES = plain_yaml.beside(__file__)
SENT = {
    "all": perception(),
    "application": goal([application()]),
    "connection": goal([], [connection()]),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_who_asks_for_approval(case: dict[str, Any]) -> None:
    repo = repo_with(appdef=case.get("appdef"), **case.get("domain", {}))
    decision = repo.send(SENT[case.get("sends", "all")])
    assert decision.approval == tuple(case["asks"])
    assert decision.outcome == "booked", "the outcome is decided although approval is needed"


def test_the_domain_of_a_node_on_which_only_a_service_runs_may_ask() -> None:
    books = repo_with(
        {"name": "cloud", "namespace": "cloud", "nodes": ["cloud"], "approval": "required"},
        nodes=["edge", "vehicle*"],
    )
    made = put("d", connect="none")
    made["applications"][0]["services"] = {"object-fusion": "cloud"}
    assert books.send(made).approval == ("access domain 'cloud'",)


def test_each_requester_needs_a_rule_that_lets_it_through() -> None:
    books = repo_with(rules=[VEHICLES, ASKS])
    assert books.send(goal([application(who=["vehicle00", "truck"])])).approval == (RULE,)


def asked(*ids: str, **changed: Any) -> Goal:
    (app,) = put("d", "v")["applications"]
    return put("d", "v", applications=[app | {"id": id} for id in ids], **changed)


def test_only_a_demand_that_adds_something_needs_approval() -> None:
    books = repo_with(approval="required", leases={"slack": "0s"})
    for made, asks in (
        (perception(), True),
        (perception(), False),
        (goal([application(ego=[EGO])]), True),
        (perception(shutdown=True), False),
        (asked("edge/first", "edge/second", lease=60), True),
        (asked("edge/first", lease=60), False),
        (asked("edge/first", lease=600), False),
        (asked(operation="renew"), False),
        (asked(operation="release"), False),
    ):
        assert books.send(made).approval == ((DOMAIN,) if asks else ())


def test_a_proposed_lease_has_no_end_and_is_written_without() -> None:
    books = repo_with(approval="required")
    decision = books.decide(asked("edge/first", lease=60))
    ledger = books.decide(replace(decision.request, awaits_approval=True)).state.ledger
    claims = ledger.claims_of_demand("d")
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
