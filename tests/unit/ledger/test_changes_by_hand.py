"""What people write in Git, an upgrade and a restoration leave.

The rules for demands are in ``tests/scenarios``, ``test_flows`` and ``test_properties``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import yaml
from demandops.connections.connection import Connection
from demandops.decide.booking import Restoration
from demandops.decide.carriers import with_one_carrier
from demandops.decide.edits import faults_of_edit
from demandops.decide.planning.flows import with_booked_topics_marked
from demandops.model.demand.demand import UNSTARTED
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim, path_of
from demandops.model.ledger.ledger import ClaimChange, ledger_of

from tests.kit.config import edited, skeleton
from tests.kit.goals import APP, CLOUD, Topic, application, connection, goal, put
from tests.kit.memory import NOW, MemoryRepo, rebuilt

FRONT, REAR = ("/front/points", "vehicle01"), ("/rear/points", "vehicle01")
"""Two point clouds of a vehicle for which the inventory names no usual topic."""
PLAIN = "/vehicle01_local_objectlist"


def join(*clouds: Topic, who: str = "vehicle01", id: str = APP) -> Any:
    return goal([application(id, who=[who], clouds=clouds)], id=f"of {who}")


def bringing(topic: str) -> Any:
    return goal([], [connection("link", topics=["/other"], targets=[topic])])


def claims_after(*goals: Any) -> list[Claim]:
    """Return the claims that the goals get if each goal is sent to a new repo of its own."""
    repos = [MemoryRepo() for _ in goals]
    for repo, one in zip(repos, goals, strict=True):
        repo.send(one)
    claims = (claim for repo in repos for claim in repo.state.ledger)
    return [claim for claim in claims if not claim.subject.id.startswith("derived/")]


def without_marks(claim: Claim) -> Claim:
    """Return a claim none of whose topics is marked as a further one of its source."""
    if not claim.is_on_application:
        return claim
    inputs = {
        role: tuple(replace(topic, further=False) for topic in topics)
        for role, topics in claim.application.inputs.items()
    }
    return replace(claim, held=claim.application.with_inputs(inputs))


def test_two_usual_clouds_which_a_person_wrote_are_told_apart_by_the_inventory() -> None:
    repo = MemoryRepo()
    repo.send(join(FRONT))
    repo.send(join(REAR, who="vehicle00"))
    repo.state = replace(repo.state, ledger=rebuilt(map(without_marks, repo.state.ledger)))
    repo.send(goal([application("cloud/x", node="cloud", clouds=[FRONT])]))
    (found,) = repo.faults(goal([application("cloud/y", node="cloud", clouds=[REAR])]))
    assert found.endswith(
        "choose one of the two topics as the usual one, and list it in topics.point_cloud of "
        "'vehicle01' in inventory/nodes.yaml"
    )


def test_what_clashes_already_may_be_asked_for_again_and_released() -> None:
    link, cloud = bringing(PLAIN), join(FRONT)
    ledger = rebuilt(claims_after(link, cloud))
    repo = MemoryRepo(state=replace(MemoryRepo().state, ledger=ledger))
    goals = (link, link | {"id": "again"}, join(FRONT, who="vehicle00"), cloud | {"shutdown": True})
    outcomes = [repo.decide(one).outcome for one in goals]
    assert outcomes == ["unchanged", "booked", "booked", "released"]


def test_a_claim_that_a_person_writes_or_restores_must_not_bring_a_topic_twice() -> None:
    here = MemoryRepo()
    here.send(join(CLOUD, id="edge/fusion-1"))
    app, link = claims_after(
        join(CLOUD, id="edge-fusion/1"), bringing("/edge_fusion_1_global_trajectories")
    )
    both = replace(here.state, ledger=rebuilt([*here.state.ledger, app, link]))
    changes = [ClaimChange(None, claim) for claim in (app, link)]
    found = [*faults_of_edit(here.state, both, changes)]
    places = [(path_of(app.key), "id"), (path_of(link.key), "topics[0].target")]
    assert [(one.file, one.field) for one in found] == places
    assert all("'edge/fusion-1' already publishes this topic" in one.message for one in found)
    refusal = here.take(Restoration(id="rollback", claims=tuple(both.ledger)))
    assert sorted(str(refusal).splitlines()) == sorted(map(str, found))


def test_a_persons_claim_of_another_type_changes_nothing_of_what_the_application_is() -> None:
    appdef = yaml.safe_load(skeleton()["appdefs/object-detection-fusion/appdef.yaml"])
    appdef["services"] = {"x": appdef["services"]["object-detection"] | {"prefix": "x"}}
    del appdef["deploymentRequest"]
    values = "values/object-detection.yaml.j2"
    repo = MemoryRepo(
        {
            "appdefs/other/appdef.yaml": yaml.safe_dump(appdef | {"name": "other"}),
            f"appdefs/other/{values}": skeleton()[f"appdefs/object-detection-fusion/{values}"],
        }
    )
    repo.send(join(CLOUD))
    (claim,) = (each for each in repo.state.ledger if each.is_on_application)
    (more,) = claims_after(join(FRONT))
    written = replace(more, demand="z", held=replace(more.application, appdef="other"))
    after = replace(repo.state, ledger=rebuilt([claim, written]))
    assert not list(faults_of_edit(repo.state, after, [ClaimChange(None, written)]))
    services = MemoryRepo(state=after).books()["services"].values()
    (inputs,) = [one["inputs"] for one in services if one["service"] == "object-fusion"]
    assert inputs["object_list"].keys() == {"/vehicle00_local_objectlist", PLAIN}


def test_an_upgrade_takes_the_oldest_cloud_for_the_usual_one() -> None:
    repo = MemoryRepo()
    repo.send(join(REAR, who="vehicle00"))
    repo.send(join(FRONT), now=repo.now.replace(hour=11))
    of_before = rebuilt(map(without_marks, repo.state.ledger))
    marked = with_booked_topics_marked(of_before, repo.config)
    apps = (claim.application for claim in marked if claim.is_on_application)
    inputs = [topic for app in apps for topic in app.inputs["point_cloud"]]
    assert {topic.topic: topic.further for topic in inputs} == {FRONT[0]: False, REAR[0]: True}


# ---- which connection carries a route ----


def listing(demand: str, id: str, *topics: dict[str, Any]) -> dict[str, Any]:
    ends = {"id": id, "source": "vehicle00", "target": "edge", "topics": list(topics)}
    return {"kind": "Demand", "demand": demand, "requesters": [demand], "connections": [ends]}


def doubled() -> list[Claim]:
    """Return the claims of two demands that list one route, as each would hold it alone."""
    late = listing("late", "new", {"source": "/a", "qos": 1}, {"source": "/b"})
    claims = []
    for hour, asked in ((11, late), (9, listing("early", "old", {"source": "/a"}))):
        repo = MemoryRepo()
        repo.send(asked, repo.now.replace(hour=hour))
        claims += list(repo.state.ledger)
    return claims


def test_an_upgrade_gives_a_route_to_the_oldest_connection_that_has_it() -> None:
    ledger, keys = with_one_carrier(ledger_of(doubled()))
    held = {
        (claim.subject.id, claim.demand): [(r.source, r.qos, r.listed) for r in claim.held.topics]
        for claim in ledger
        if isinstance(claim.held, Connection)
    }
    assert held == {
        ("old", "early"): [("/a", 0, "")],
        ("old", "late"): [("/a", 0, "new")],
        ("new", "late"): [("/b", 0, "")],
    }
    assert {key.subject.id for key in keys} == {"old", "new"}
    assert with_one_carrier(ledger) == (ledger, [])


def test_a_claim_by_hand_that_doubles_a_route_is_invalid_and_a_restored_one_is_united() -> None:
    late, early = doubled()
    repo = MemoryRepo()
    before = replace(repo.state, ledger=ledger_of([early]))
    after = replace(repo.state, ledger=ledger_of([early, late]))
    (found,) = faults_of_edit(before, after, [ClaimChange(None, late)])
    assert (found.file, found.field) == (path_of(late.key), "topics[0]")
    assert "connection 'old' carries this topic" in found.message
    repo.send(Restoration(id="rollback", claims=(late, early)))
    carried = {
        (claim.subject.id, route.source)
        for claim in repo.state.ledger
        for route in claim.connection.topics
    }
    assert carried == {("old", "/a"), ("new", "/b")}


def test_an_edit_by_hand_changes_what_nodes_have_left() -> None:
    appdef = "appdefs/object-detection-fusion/appdef.yaml"
    repo = MemoryRepo(edited(appdef, "prefix: of", "prefix: of\n    requests: {cpu: 1}"))
    repo.take_all([put("a"), put("b")])
    known, ledger = repo.state, repo.state.ledger
    _ = known.usage
    gone = [claim for claim in ledger if claim.is_on_application][:1]
    left = known.with_ledger(ledger.without(gone), [ClaimChange(gone[0], None)])
    assert left.usage.amounts == replace(known, ledger=left.ledger).usage.amounts
    assert left.usage.amounts != known.usage.amounts


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
