"""Access domains, their rules and application definitions can require approval of demands."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from demandops.decide.admission.permission import with_leases_from_approval
from demandops.decide.decision import decide
from demandops.model.demand.claim import UNSTARTED
from demandops.model.ledger import claim_file

from tests.kit.config import edited, skeleton
from tests.kit.goals import APP, EGO, application, connection, goal, perception
from tests.kit.memory import NOW, MemoryRepo

POLICY = "policy/access-domains.yaml"
DOMAIN = "access domain 'perception'"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"


def policy(**changed: Any) -> dict[str, str]:
    """Return the skeleton's policy, with some fields of its only domain changed."""
    data = yaml.safe_load(skeleton()[POLICY])
    data["domains"][0].update(changed)
    return {POLICY: yaml.safe_dump(data)}


def rules(*made: dict[str, Any], **more: Any) -> dict[str, str]:
    return policy(rules=list(made), **more)


NOBODY = ()
ALL = {"name": "all"}
ASKS = {"name": "asks", "approval": "required"}
VEHICLES = {"name": "vehicles", "requesters": ["vehicle*"], "approval": "none"}


@pytest.mark.parametrize(
    ("config", "asks"),
    [
        pytest.param({}, NOBODY, id="nothing said"),
        pytest.param(policy(approval="none"), NOBODY, id="none said"),
        pytest.param(policy(approval="required"), (DOMAIN,), id="domain"),
        pytest.param(rules(ALL, approval="required"), (DOMAIN,), id="rule inherits"),
        pytest.param(rules(ASKS), (f"rule 'asks' of {DOMAIN}",), id="rule"),
        pytest.param(rules(ASKS, ALL), NOBODY, id="another rule lets through"),
        pytest.param(rules(ASKS, VEHICLES), NOBODY, id="a narrower rule lets through"),
        pytest.param(rules(ALL, VEHICLES, approval="required"), NOBODY, id="rule excepts"),
        pytest.param(
            edited(
                APPDEF,
                "kind: ApplicationDefinition",
                "kind: ApplicationDefinition\napproval: required",
            ),
            ("application definition 'object-detection-fusion'",),
            id="appdef",
        ),
    ],
)
def test_who_asks_for_approval(config: dict[str, str], asks: tuple[str, ...]) -> None:
    decision = MemoryRepo(config).send(perception())
    assert decision.approval == asks
    assert decision.outcome == "booked", "the outcome is decided although approval is needed"


def test_each_requester_needs_a_rule_that_lets_it_through() -> None:
    books = MemoryRepo(rules(VEHICLES, ASKS))
    assert books.send(goal([application(who=["vehicle00", "truck"])])).approval == (
        f"rule 'asks' of {DOMAIN}",
    )


def test_a_rule_for_another_application_or_node_lets_nothing_through() -> None:
    elsewhere = {"name": "elsewhere", "nodes": ["cloud"], "approval": "none"}
    other = {"name": "other", "applications": ["recorder"], "approval": "none"}
    books = MemoryRepo(rules(ASKS, elsewhere, other))
    assert books.send(goal([application()])).approval == (f"rule 'asks' of {DOMAIN}",)
    # a connection has no application, so a rule for another application covers it
    assert books.send(goal([], [connection()], id="other")).approval == ()


def test_an_appdef_asks_for_its_applications_and_not_for_connections() -> None:
    text = "kind: ApplicationDefinition"
    books = MemoryRepo(edited(APPDEF, text, f"{text}\napproval: required"))
    assert books.send(goal([], [connection()])).approval == ()


def test_only_a_demand_that_adds_something_needs_approval() -> None:
    books = MemoryRepo(policy(approval="required"))
    assert books.send(perception()).approval == (DOMAIN,)
    assert books.send(perception()).approval == ()
    assert books.send(goal([application(ego=[EGO])])).approval == (DOMAIN,)
    assert books.send(perception(shutdown=True)).approval == ()


def put(**changed: Any) -> dict[str, Any]:
    """Return a `Demand` for one application; ``changed`` adds or replaces fields."""
    inputs = {"point_cloud": [{"topic": "/stations/station00/pointcloud", "source": "station00"}]}
    app = {"id": APP, "type": "object-detection-fusion", "node": "edge", "inputs": inputs}
    head = {"apiVersion": "demandops/v1", "kind": "Demand", "demand": "d", "requesters": ["v"]}
    return head | {"applications": [app]} | changed


def test_dropping_renewing_and_releasing_need_none() -> None:
    books = MemoryRepo(policy(approval="required", leases={"slack": "0s"}))
    app = put()["applications"][0]
    two = [app, app | {"id": "edge/second"}]
    assert books.send(put(applications=two, lease=60)).approval == (DOMAIN,)
    assert books.send(put(lease=60)).approval == (), "a put of less must need no approval"
    assert books.send(put(lease=600)).approval == (), "a longer lease must need no approval"
    head = {key: value for key, value in put().items() if key != "applications"}
    assert books.send(head | {"operation": "renew"}).approval == ()
    assert books.send(head | {"operation": "release"}).approval == ()


def test_a_proposed_lease_has_no_end_and_is_written_without() -> None:
    books = MemoryRepo(policy(approval="required"))
    decision = decide(books.state, put(lease=60), NOW, books.files.get)
    waiting = decide(books.state, with_leases_from_approval(decision.request), NOW, books.files.get)
    [claim] = [
        one for one in waiting.state.ledger.claims_of_demand("d") if "edge" in one.subject.id
    ][:1]
    assert claim.lease is not None
    assert claim.lease.until == UNSTARTED
    assert not claim.lease.has_started
    path = claim_file.path_of(claim.key)
    text = claim_file.text_of(claim)
    assert "until" not in text
    assert claim_file.read(text, path) == claim
    found = {one.key for one in waiting.state.ledger.unstarted_claims()}
    assert found == {one.key for one in waiting.state.ledger.claims_of_demand("d")}
    later = claim.lease.started(NOW)
    assert (later.seconds, (later.until - NOW).total_seconds()) == (60, 60)
    assert waiting.state.ledger.ended_claims(NOW.replace(year=2100)) == ()
