"""The state of releases follows from the objects of Flux and Argo CD, as the API gives them."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from operator import itemgetter
from typing import Any

import pytest
from demandops.cluster.health import (
    REQUESTED_AT,
    ClusterDomain,
    Flux,
    Health,
    ObjectSelector,
    Target,
    health_reader,
    worst,
)

from tests.kit import plain_yaml
from tests.unit.cluster.cases import Case, Letters, condition, deployments, told

COMMITS = Letters()
ARGOCD_CASES, FLUX_CASES = (plain_yaml.beside(__file__, name) for name in ("argocd", "flux"))
PLACE = ClusterDomain("c-its", "perception", "ns")


def targets_in(place: ClusterDomain) -> dict[str, Target]:
    return {
        "service": Target(place, "od-edge", is_service=True),
        "client": Target(place, "mqtt-a", is_service=False),
        "gone": Target(place, "od-edge", is_service=True, wanted=False),
    }


# ---- Flux ----

FLUX = health_reader(PLACE)
OVER = ("Kustomization", "ns", "perception")
SOURCE = ("GitRepository", "ns", "demandops")
HELM = ("HelmRelease", "ns", "od-edge")


def kustomization(applied: str, attempted: str, conditions: Iterable[Any] = ()) -> dict[str, Any]:
    status: dict[str, Any] = {"lastAppliedRevision": applied and f"main@sha1:{applied}"}
    status["lastAttemptedRevision"] = attempted and f"main@sha1:{attempted}"
    status["conditions"] = [condition(*one) for one in conditions]
    return {"metadata": {}, "spec": {"sourceRef": {"name": "demandops"}}, "status": status}


def release(conditions: Iterable[Any] = (), observed: int = 2) -> dict[str, Any]:
    listed = [condition(*one) for one in conditions]
    status = {"observedGeneration": observed, "conditions": listed}
    return {"metadata": {"generation": 2}, "status": status}


@pytest.mark.parametrize("case", FLUX_CASES["domain"], ids=itemgetter("when"))
def test_an_access_domain_is_as_far_as_its_kustomization(case: Case) -> None:
    objects = {OVER: kustomization(**case["over"])} if "over" in case else {}
    if "source" in case:
        conditions = [condition(*one) for one in case["source"]]
        objects[SOURCE] = {"metadata": {}, "status": {"conditions": conditions}}
    assert told(FLUX.domain_health(PLACE, "b", objects, COMMITS), case) == case


@pytest.mark.parametrize("case", FLUX_CASES["release"], ids=itemgetter("when"))
def test_a_release_is_healthy_when_helm_and_all_its_deployments_are(case: Case) -> None:
    objects = deployments(case) | ({HELM: release(**case["helm"])} if "helm" in case else {})
    target = targets_in(PLACE)[case.get("of", "service")]
    assert told(FLUX.release_health(target, "b", objects, COMMITS), case) == case


def test_the_whole_is_as_far_as_its_least_and_a_failure_is_told_first() -> None:
    slow, failed = Health("reconciled", "slow"), Health("reconciled", "failed", failing=True)
    assert worst([Health("healthy"), slow, failed]) == failed
    assert worst([Health("healthy"), slow, Health("waiting")]) == Health("waiting")
    assert worst([]).state == "healthy"


def test_since_when_is_the_cluster_s_to_say() -> None:
    found = {HELM: release([("Ready", "True")])}
    service, client, _ = targets_in(PLACE).values()
    assert FLUX.last_transition(service, found) == "2026-05-04T12:00:00Z"
    assert FLUX.last_transition(client, found) == ""


def test_levels_are_in_order() -> None:
    levels: tuple[Any, ...] = ("pushed", "reconciled", "healthy")
    states: tuple[Any, ...] = ("waiting", "reconciled", "healthy")
    for reached, state in enumerate(states, start=1):
        found = [level for level in levels if Health(state).reaches(level)]
        assert found == [*levels[:reached]]


@pytest.mark.parametrize("case", FLUX_CASES["idle"], ids=itemgetter("when"))
def test_a_domain_is_idle_once_the_last_fetch_is_applied(case: Case) -> None:
    objects: dict[tuple[str, str, str], Any] = {}
    if "fetches" in case:
        fetched, asked, handled = case["fetches"]
        artifact = {"revision": f"main@sha1:{fetched}"}
        objects[SOURCE] = {
            "metadata": {"annotations": {REQUESTED_AT: asked}},
            "spec": {"suspend": case.get("suspend", False)},
            "status": {"artifact": artifact, "lastHandledReconcileAt": handled},
        }
        applied, attempted, ready = case["applies"]
        objects[OVER] = kustomization(applied, attempted, [("Ready", ready)])
    assert Flux().is_idle(PLACE, objects, before="1") is case["idle"]


def test_a_domain_that_was_never_asked_to_fetch_is_idle() -> None:
    never = {"metadata": {}, "status": {"artifact": {"revision": "main@sha1:a"}}}
    objects = {SOURCE: never, OVER: kustomization("a", "a", [("Ready", "True", "applied")])}
    assert Flux().is_idle(PLACE, objects, before=None)
    assert Flux().handled_request(PLACE, objects) == ""


# ---- Argo CD ----

IN_ARGOCD = ClusterDomain(
    "c-its", "perception", "ns", ObjectSelector("Application", "argocd", "demandops-perception")
)
ARGOCD = health_reader(IN_ARGOCD)
APPLICATION = ("Application", "argocd", "demandops-perception")
CHILD = ("Application", "ns", "od-edge")
AT = "2026-05-04T12:00:00Z"


def nested(depth: int) -> list[Any]:
    return [nested(depth - 1)] if depth else []


SOURCES: dict[str, dict[str, Any]] = ARGOCD_CASES["sources"]
SOURCES["deep"] = deepcopy(SOURCES["new"])
SOURCES["deep"]["helm"]["valuesObject"] = {"image": nested(900)}


def application(default: str, **fields: Any) -> dict[str, Any]:
    """Return the Application that a case describes; it was compared if ``sync`` is set."""
    source = fields.get("source", default)
    wanted, names = SOURCES[source], fields.get("resources", ())
    named = {"group": "apps", "kind": "Deployment", "namespace": "ns"}
    status: dict[str, Any] = {
        "conditions": [condition(kind, "", text) for kind, text in fields.get("conditions", ())],
        "resources": [named | {"name": name} for name in names],
        "health": {"status": fields.get("health", "Healthy"), "lastTransitionTime": AT},
    }
    if "sync" in fields:
        against = {"source": SOURCES[fields.get("compared", source)]}
        status["sync"] = {"status": fields["sync"], "revision": fields.get("at", "")}
        status["sync"]["comparedTo"] = against
    if "operation" in fields:
        status["operationState"] = synced(**{"of": default} | fields["operation"])
    deleted = {"deletionTimestamp": AT} if fields.get("deleted") else {}
    return {"metadata": {"name": "x"} | deleted, "spec": {"source": wanted}, "status": status}


def synced(phase: str, revision: str, of: str, message: str = "", **more: Any) -> dict[str, Any]:
    """Return the ``operationState`` of a sync from the source ``of``."""
    result = {"revision": revision, "source": SOURCES[of], "resources": more.pop("resources", [])}
    asked = {"sync": {"revision": revision, "resources": more.pop("only", None)}}
    return {
        "phase": phase, "message": message, "syncResult": result, "operation": asked, **more
    }  # fmt: skip


@pytest.mark.parametrize("case", ARGOCD_CASES["domain"], ids=itemgetter("when"))
def test_an_access_domain_is_as_far_as_the_application_over_its_folder(case: Case) -> None:
    objects = {APPLICATION: application("folder", **case["over"])} if "over" in case else {}
    health = ARGOCD.domain_health(IN_ARGOCD, "b", objects, COMMITS)
    assert told(health, case) == case
    assert health.object in ("", "Application argocd/demandops-perception")


@pytest.mark.parametrize("case", ARGOCD_CASES["release"], ids=itemgetter("when"))
def test_a_release_is_healthy_when_it_is_synced_as_it_stands_now_and_all_is_there(
    case: Case,
) -> None:
    objects = {APPLICATION: application("folder", sync="Synced", at="b"), **deployments(case)}
    if "child" in case:
        objects[CHILD] = application("new", **case["child"])
    history = Letters([case["changing"]] if "changing" in case else [])
    health = ARGOCD.release_health(
        targets_in(IN_ARGOCD)[case.get("of", "service")], "b", objects, history
    )
    assert told(health, case) == case


def test_applied_commit_and_last_transition_come_from_the_applications_in_the_cluster() -> None:
    over, child = application("folder", sync="Synced", at="b"), application("new")
    succeeded = {"phase": "Succeeded", "revision": "b"}
    under_way = application("folder", sync="OutOfSync", at="c", operation=succeeded)
    assert ARGOCD.applied_commit(IN_ARGOCD, {APPLICATION: over}) == "b"
    assert ARGOCD.applied_commit(IN_ARGOCD, {}) == ""
    assert ARGOCD.applied_commit(IN_ARGOCD, {APPLICATION: under_way}) == "b"
    service, client, _ = targets_in(IN_ARGOCD).values()
    assert ARGOCD.last_transition(service, {CHILD: child}) == AT
    assert ARGOCD.last_transition(client, {CHILD: child}) == ""


def test_only_one_object_of_argo_cds_namespace_is_read() -> None:
    """The generator may lack the right to read other objects in Argo CD's namespace."""
    assert ARGOCD.objects_to_watch(IN_ARGOCD)[0] == ObjectSelector(*APPLICATION)
