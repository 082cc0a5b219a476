"""Detection and fusion publish the reference's topics; no node gets a topic from two sources."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import yaml
from demandops.decide.decision import faults_of_edit
from demandops.decide.planning.flows import with_booked_topics_marked
from demandops.decide.restoration import Restoration
from demandops.model.demand.claim import Claim
from demandops.model.ledger.claim_file import path_of
from demandops.model.ledger.ledger import ClaimChange

from tests.kit.config import skeleton
from tests.kit.goals import APP, CLOUD, Topic, application, connection, goal
from tests.kit.memory import MemoryRepo, rebuilt

FRONT, REAR = ("/front/points", "vehicle01"), ("/rear/points", "vehicle01")
"""Two point clouds of a vehicle for which the inventory names no usual topic."""
PLAIN = "/vehicle01_local_objectlist"
REAR_SLUG = "/vehicle01_rear_points_cf82ae10af3d_local_objectlist"
NODES = "inventory/nodes.yaml"


def join(*clouds: Topic, who: str = "vehicle01", id: str = APP, shutdown: bool = False) -> Any:
    return goal([application(id, who=[who], clouds=clouds)], id=f"of {who}", shutdown=shutdown)


def published(repo: MemoryRepo) -> dict[str, str]:
    """Map each detection's input topic (a point cloud) to its output topic (an object list)."""
    values = [release["spec"]["values"] for release in repo.objects("HelmRelease").values()]
    detections = [one["detection"] for one in values if "detection" in one]
    return {one["pointCloudTopic"]: one["objectListTopic"] for one in detections}


def fused(repo: MemoryRepo) -> set[str]:
    values = [release["spec"]["values"] for release in repo.objects("HelmRelease").values()]
    return {topic for one in values if "inputs" in one for topic in one["inputs"]["objectList"]}


def with_nodes(*nodes: dict[str, Any]) -> MemoryRepo:
    """Return a repo whose inventory has these further nodes, or these fields of known nodes."""
    inventory = yaml.safe_load(skeleton()[NODES])
    known = {node["id"]: node for node in inventory["nodes"]}
    for node in nodes:
        known.setdefault(node["id"], {"type": "vehicle", "cluster": "c-its"}).update(node)
    return MemoryRepo({NODES: yaml.safe_dump(inventory | {"nodes": [*known.values()]})})


def test_the_fusion_publishes_what_the_reference_names() -> None:
    repo = MemoryRepo()
    repo.send(join(CLOUD, id="edge/object-detection_fusion"))
    (fusion,) = [
        release["spec"]["values"]["fusion"]
        for release in repo.objects("HelmRelease").values()
        if "fusion" in release["spec"]["values"]
    ]
    assert fusion["fusedObjectListsTopic"] == "/edge_object_detection_fusion_global_objectlist"
    assert fusion["fusedTrajectoriesTopic"] == "/edge_object_detection_fusion_global_trajectories"


@pytest.mark.parametrize("at_once", [True, False])
def test_the_first_cloud_of_a_source_is_its_usual_one_and_names_stay_while_they_are_demanded(
    at_once: bool,
) -> None:
    repo = MemoryRepo()
    for clouds in [(FRONT, REAR)] if at_once else [(FRONT,), (REAR,)]:
        repo.send(join(*clouds))
    both = {FRONT[0]: PLAIN, REAR[0]: REAR_SLUG}
    assert published(repo) == both
    assert fused(repo) == set(both.values())
    assert repo.decide(join(REAR, FRONT)).outcome == "unchanged"
    repo.send(join(FRONT, shutdown=True))
    assert published(repo) == {REAR[0]: REAR_SLUG}
    repo.send(join(REAR, who="vehicle00"))
    repo.send(join(REAR, shutdown=True))
    assert published(repo) == {REAR[0]: REAR_SLUG}
    repo.send(join(REAR, who="vehicle00", shutdown=True))
    repo.send(join(REAR))
    assert published(repo) == {REAR[0]: PLAIN}


def test_the_inventory_says_which_cloud_is_the_usual_one() -> None:
    repo = with_nodes({"id": "vehicle01", "topics": {"point_cloud": REAR[0]}})
    repo.send(join(FRONT))
    slug = "/vehicle01_front_points_4d80b6efb186_local_objectlist"
    assert published(repo) == {FRONT[0]: slug}
    repo.send(join(REAR))
    assert published(repo) == {FRONT[0]: slug, REAR[0]: PLAIN}


def put(*clouds: Topic) -> dict[str, Any]:
    topics = [{"topic": topic, "source": source} for topic, source in clouds]
    item = {"id": APP, "type": "object-detection-fusion", "node": "edge", "connect": "none"}
    inputs = {"inputs": {"point_cloud": topics}}
    head = {"kind": "Demand", "demand": "d", "requesters": ["vehicle01"]}
    return head | {"applications": [item | inputs]}


def test_a_cloud_that_takes_the_place_of_another_takes_its_name_too() -> None:
    repo = MemoryRepo()
    repo.send(put(FRONT))
    repo.send(put(REAR))
    assert published(repo) == {REAR[0]: PLAIN}
    repo.send(put(FRONT, REAR))
    repo.send(put(FRONT, REAR))
    assert published(repo)[REAR[0]] == PLAIN


def test_an_application_whose_topics_another_publishes_is_refused() -> None:
    repo = MemoryRepo()
    repo.send(join(CLOUD, id="edge/fusion-1"))
    assert repo.faults(join(CLOUD, id="edge-fusion/1")) == [
        "apps[0].header.id: output fused_objects of object-fusion is "
        "/edge_fusion_1_global_objectlist, but application 'edge/fusion-1' already publishes this "
        "topic on 'edge'; use another application id"
    ]
    repo.send(goal([application("edge-fusion/1", node="cloud")]))


OTHER = """
apiVersion: demandops/v1
kind: ApplicationDefinition
name: other
inputs: {point_cloud: {}}
services:
  other:
    prefix: ot
    each: point_cloud
    outputs: {objects: "/{instance}_local_objectlist"}
    chart: object-detection
    values: values/other.yaml.j2
"""


def test_another_definition_with_the_same_output_must_change() -> None:
    """If the id or the usual topic changed, both outputs would still have the same name."""
    values = "appdefs/other/values/other.yaml.j2"
    repo = MemoryRepo({"appdefs/other/appdef.yaml": OTHER, values: "replicas: 1\n"})
    repo.send(put(FRONT))
    (item,) = put(FRONT)["applications"]
    again = put() | {"demand": "e", "applications": [item | {"id": "edge/o", "type": "other"}]}
    (found,) = repo.faults(again)
    assert found.endswith("on 'edge'; change this output in appdefs/other/appdef.yaml")


def test_an_output_that_does_not_name_its_instance_must_change() -> None:
    path = "appdefs/object-detection-fusion/appdef.yaml"
    repo = MemoryRepo({path: skeleton()[path].replace("/{instance}_global_objectlist", "/fused")})
    repo.send(join(CLOUD, id="edge/a"))
    (found,) = repo.faults(join(CLOUD, id="edge/b"))
    assert found.endswith(f"on 'edge'; change this output in {path}")


def test_a_source_whose_topic_another_publishes_is_refused() -> None:
    repo = with_nodes({"id": "robo-1"}, {"id": "robo/1", "selector": {"a": "b"}})
    repo.send(join(("/a", "robo-1")))
    assert repo.faults(join(("/b", "robo/1"), id="edge/other")) == [
        "apps[0].object_detection_fusion_app.pointcloud_topics[0].topic_name: output "
        "object_list of object-detection is /robo_1_local_objectlist, but object-detection for /a "
        "of 'robo-1' already publishes this topic on 'edge'; give 'robo/1' another id in "
        "inventory/nodes.yaml"
    ]


def test_two_usual_clouds_which_a_person_wrote_are_told_apart_by_the_inventory() -> None:
    repo = MemoryRepo()
    repo.send(join(FRONT))
    repo.send(join(REAR, who="vehicle00"))
    claims = [replace(claim, held=without_marks(claim)) for claim in repo.state.ledger]
    repo.state = replace(repo.state, ledger=rebuilt(claims))
    repo.send(goal([application("cloud/x", node="cloud", clouds=[FRONT])]))
    assert repo.faults(goal([application("cloud/y", node="cloud", clouds=[REAR])])) == [
        "apps[0].object_detection_fusion_app.pointcloud_topics[0].topic_name: output "
        "object_list of object-detection is /vehicle01_local_objectlist, but object-detection "
        "for /front/points of 'vehicle01' already publishes this topic on 'cloud'; choose one of "
        "the two topics as the usual one, and list it in topics.point_cloud of 'vehicle01' in "
        "inventory/nodes.yaml"
    ]


def bringing(topic: str, **more: Any) -> Any:
    return goal([], [connection("link", topics=["/other"], targets=[topic], **more)])


@pytest.mark.parametrize("at_once", [True, False])
def test_an_application_whose_topic_a_connection_brings_is_refused(at_once: bool) -> None:
    repo = MemoryRepo()
    link, app = bringing("/edge_1_global_objectlist"), join(CLOUD, id="edge/1")
    if at_once:
        app["connections"] = link["connections"]
    else:
        repo.send(link)
    assert repo.faults(app) == [
        "apps[0].header.id: output fused_objects of object-fusion is /edge_1_global_objectlist, "
        "but connection 'link' already brings this topic to 'edge'; use another application id"
    ]


def test_a_source_whose_topic_a_connection_brings_is_refused() -> None:
    repo = MemoryRepo()
    repo.send(bringing(PLAIN))
    assert repo.faults(join(FRONT)) == [
        "apps[0].object_detection_fusion_app.pointcloud_topics[0].topic_name: output "
        f"object_list of object-detection is {PLAIN}, but connection 'link' already brings this "
        "topic to 'edge'; let the connection bring the topic under another name"
    ]
    repo.send(join(REAR, FRONT, shutdown=False) | {"apps": [application(node="cloud")]})


@pytest.mark.parametrize(("topic", "cloud"), [(PLAIN, FRONT), (REAR_SLUG, REAR)])
def test_a_connection_that_brings_what_a_service_publishes_is_refused(
    topic: str, cloud: Topic
) -> None:
    repo = MemoryRepo()
    repo.send(join(FRONT, REAR))
    clash = (
        f"connection 'link' brings {topic} to 'edge', where object-detection for {cloud[0]} of "
        "'vehicle01' already publishes this topic; use a connection that brings the topic under "
        "another name"
    )
    assert repo.faults(bringing(topic)) == [f"connections[0].target_topics[0]: {clash}"]
    repo.send(bringing(topic, ends=("edge", "vehicle00")))
    back = {"id": "link", "type": "mqtt", "source": "edge", "target": "vehicle01"}
    back |= {"topics": [{"source": topic, "target": "/other", "reverse": True}]}
    head = {"kind": "Demand", "demand": "d", "requesters": ["vehicle01"]}
    assert MemoryRepo(state=repo.state).faults(head | {"connections": [back | {"id": "back"}]}) == [
        f"connections[0].topics[0].source: {clash.replace('link', 'back')}"
    ]


def claims_after(*goals: Any) -> list[Claim]:
    """Return the claims that the goals get if each goal is sent to a new repo of its own."""
    repos = [MemoryRepo() for _ in goals]
    for repo, one in zip(repos, goals, strict=True):
        repo.send(one)
    return [claim for repo in repos for claim in repo.state.ledger]


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
    found = [*map(str, faults_of_edit(here.state, both, changes))]
    refusal = here.take(Restoration("rollback", claims=tuple(both.ledger)))
    assert sorted(str(refusal).splitlines()) == sorted(found)
    assert found == [
        f"{path_of(app.key)}: id: output fused_objects of object-fusion is "
        "/edge_fusion_1_global_objectlist, but application 'edge/fusion-1' already publishes this "
        "topic on 'edge'; use another application id",
        f"{path_of(link.key)}: topics[0].target: connection 'link' brings "
        "/edge_fusion_1_global_trajectories to 'edge', where application 'edge/fusion-1' "
        "already publishes this topic; use a connection that brings the topic under another name",
    ]


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
    (claim,) = repo.state.ledger
    (more,) = claims_after(join(FRONT, who="vehicle01"))
    written = replace(more, demand="z", held=replace(more.application, appdef="other"))
    after = replace(repo.state, ledger=rebuilt([claim, written]))
    assert not list(faults_of_edit(repo.state, after, [ClaimChange(None, written)]))
    services = MemoryRepo(state=after).books()["services"].values()
    (inputs,) = [one["inputs"] for one in services if one["service"] == "object-fusion"]
    assert inputs["object_list"] == {
        "/vehicle00_local_objectlist": ["vehicle01"],
        PLAIN: ["vehicle01"],
    }


def without_marks(claim: Claim) -> Any:
    inputs = {
        role: tuple(topic._replace(further=False) for topic in topics)
        for role, topics in claim.application.inputs.items()
    }
    return claim.application.with_inputs(inputs)


def test_an_upgrade_takes_the_oldest_cloud_for_the_usual_one() -> None:
    repo = MemoryRepo()
    repo.send(join(REAR, who="vehicle00"))
    repo.send(join(FRONT), now=repo.now.replace(hour=11))
    of_before = rebuilt(replace(claim, held=without_marks(claim)) for claim in repo.state.ledger)
    marked = with_booked_topics_marked(of_before, repo.config)
    inputs = [topic for claim in marked for topic in claim.application.inputs["point_cloud"]]
    assert {topic.topic: topic.further for topic in inputs} == {FRONT[0]: False, REAR[0]: True}


def test_a_topic_in_another_role_hides_no_usual_topic() -> None:
    repo = MemoryRepo()
    ego = ("/odd/ego", "vehicle01")
    repo.send(goal([application("edge/a", who=["v"], ego=[ego], clouds=[])], id="a"))
    repo.send(goal([application("edge/b", who=["v"], clouds=[FRONT])], id="b"))
    usual = repo.state.ledger.usual_topics
    assert [*usual("ego_data", "vehicle01", excluded=FRONT[0])] == ["/odd/ego"]
    assert [*usual("ego_data", "vehicle01", excluded="/odd/ego")] == []
    assert [*usual("point_cloud", "vehicle01", excluded="")] == [FRONT[0]]
