"""Access domains, their rules and application definitions can require approval of demands."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from demandops.decide.admission.permission import with_leases_from_approval
from demandops.model.demand.claim import UNSTARTED
from demandops.model.ledger import claim_file

from tests.kit.config import edited, skeleton
from tests.kit.goals import EGO, Goal, application, connection, goal, perception, put
from tests.kit.memory import NOW, MemoryRepo

POLICY = "policy/access-domains.yaml"
DOMAIN = "access domain 'perception'"
RULE = f"rule 'asks' of {DOMAIN}"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"


def policy(*more: dict[str, Any], **changed: Any) -> dict[str, str]:
    """Return the skeleton's policy, with fields of its domain changed, and with more domains."""
    data = yaml.safe_load(skeleton()[POLICY])
    data["domains"] = [data["domains"][0] | changed, *more]
    return {POLICY: yaml.safe_dump(data)}


def rules(*made: dict[str, Any], **more: Any) -> dict[str, str]:
    return policy(rules=list(made), **more)


ALL = {"name": "all"}
ASKS = {"name": "asks", "approval": "required"}
VEHICLES = {"name": "vehicles", "requesters": ["vehicle*"], "approval": "none"}
ELSEWHERE = {"name": "elsewhere", "nodes": ["cloud"], "approval": "none"}
OTHERS = {"name": "others", "applications": ["recorder"], "approval": "none"}
OF_APPDEF = edited(
    APPDEF, "kind: ApplicationDefinition", "kind: ApplicationDefinition\napproval: required"
)
LINK = goal([], [connection()])
OPEN = {"name": "open", "namespace": "open", "nodes": ["edge", "vehicle*"]}
ON_CLOUD = put("d", connect="none")
ON_CLOUD["applications"][0]["services"] = {"object-fusion": "cloud"}


@pytest.mark.parametrize(
    ("config", "sent", "asks"),
    [
        pytest.param({}, perception(), (), id="nothing said"),
        pytest.param(policy(approval="none"), perception(), (), id="none said"),
        pytest.param(policy(approval="required"), perception(), (DOMAIN,), id="domain"),
        pytest.param(
            rules(ALL, approval="required"), perception(), (DOMAIN,), id="rule inherits"
        ),
        pytest.param(rules(ASKS), perception(), (RULE,), id="rule"),
        pytest.param(rules(ASKS, ALL), perception(), (), id="another rule lets through"),
        pytest.param(rules(ASKS, VEHICLES), perception(), (), id="a narrower rule lets through"),
        pytest.param(
            rules(ALL, VEHICLES, approval="required"), perception(), (), id="rule excepts"
        ),
        pytest.param(
            rules(ASKS, ELSEWHERE, OTHERS), goal([application()]), (RULE,),
            id="a rule for another application or node lets nothing through",
        ),
        pytest.param(
            rules(ASKS, ELSEWHERE, OTHERS), LINK, (),
            id="a connection has no application, so a rule for another application covers it",
        ),
        pytest.param(
            OF_APPDEF, perception(),
            ("application definition 'object-detection-fusion'",), id="appdef",
        ),
        pytest.param(OF_APPDEF, LINK, (), id="an appdef does not ask for connections"),
        pytest.param(
            policy(OPEN, nodes=["cloud"], name="cloud", approval="required"), ON_CLOUD,
            ("access domain 'cloud'",), id="the domain of a node on which only a service runs",
        ),
    ],
)  # fmt: skip
def test_who_asks_for_approval(config: dict[str, str], sent: Goal, asks: tuple[str, ...]) -> None:
    decision = MemoryRepo(config).send(sent)
    assert decision.approval == asks
    assert decision.outcome == "booked", "the outcome is decided although approval is needed"


def test_each_requester_needs_a_rule_that_lets_it_through() -> None:
    books = MemoryRepo(rules(VEHICLES, ASKS))
    assert books.send(goal([application(who=["vehicle00", "truck"])])).approval == (RULE,)


def asked(*ids: str, **changed: Any) -> Goal:
    (app,) = put("d", "v")["applications"]
    return put("d", "v", applications=[app | {"id": id} for id in ids], **changed)


def test_only_a_demand_that_adds_something_needs_approval() -> None:
    books = MemoryRepo(policy(approval="required", leases={"slack": "0s"}))
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
    books = MemoryRepo(policy(approval="required"))
    decision = books.decide(asked("edge/first", lease=60))
    ledger = books.decide(with_leases_from_approval(decision.request)).state.ledger
    claims = ledger.claims_of_demand("d")
    claim = next(one for one in claims if one.is_on_application)
    assert claim.lease is not None
    assert claim.lease.until == UNSTARTED
    assert not claim.lease.has_started
    text = claim_file.text_of(claim)
    assert "until" not in text
    assert claim_file.read(text, claim_file.path_of(claim.key)) == claim
    assert {one.key for one in ledger.unstarted_claims()} == {one.key for one in claims}
    later = claim.lease.started(NOW)
    assert (later.seconds, (later.until - NOW).total_seconds()) == (60, 60)
    assert ledger.ended_claims(NOW.replace(year=2100)) == ()
