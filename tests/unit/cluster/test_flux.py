"""The state of releases follows from Flux's objects, as the API gives them."""

from __future__ import annotations

from typing import Any

import pytest
from demandops.cluster.health import (
    REQUESTED_AT,
    ClusterDomain,
    Flux,
    Health,
    Target,
    deployment_health,
    health_reader,
    worst,
)

from tests.kit.cluster import Letters, condition, deployment

COMMITS = Letters()
PLACE = ClusterDomain("c-its", "perception", "ns")
SERVICE = Target(PLACE, "od-edge", is_service=True)
CLIENT = Target(PLACE, "mqtt-a", is_service=False)
GONE = Target(PLACE, "od-edge", is_service=True, wanted=False)
FLUX = health_reader(PLACE)


def kustomization(applied: str = "", attempted: str = "", *conditions: Any) -> dict[str, Any]:
    status = {"lastAppliedRevision": applied and f"main@sha1:{applied}"}
    status["lastAttemptedRevision"] = attempted and f"main@sha1:{attempted}"
    spec = {"sourceRef": {"name": "demandops"}}
    return {"metadata": {}, "spec": spec, "status": status | {"conditions": list(conditions)}}


def release(*conditions: Any, generation: int = 2, observed: int = 2) -> dict[str, Any]:
    status = {"observedGeneration": observed, "conditions": list(conditions)}
    return {"metadata": {"generation": generation}, "status": status}


@pytest.mark.parametrize(
    ("found", "state", "reason", "failing"),
    [
        (None, "waiting", "does not exist; apply bootstrap/c-its.yaml to the cluster", False),
        (kustomization("a", "a"), "waiting", "has not applied the commit yet", False),
        (kustomization("b", "b"), "reconciled", "", False),
        (kustomization("c", "c"), "reconciled", "", False),
        (kustomization("a", "b", condition("Ready", "False", "no such kind")), "waiting",
         "no such kind", True),
        (kustomization("a", "a", condition("Ready", "False", "of an older commit")), "waiting",
         "has not applied the commit yet", False),
    ],
)  # fmt: skip
def test_an_access_domain_is_as_far_as_its_kustomization(
    found: dict[str, Any] | None, state: str, reason: str, failing: bool
) -> None:
    objects = {("Kustomization", "ns", "perception"): found} if found else {}
    health = FLUX.domain_health(PLACE, "b", objects, COMMITS)
    assert (health.state, health.failing) == (state, failing)
    assert reason in health.reason


def test_a_source_that_cannot_be_fetched_is_the_reason() -> None:
    source = {"metadata": {}, "status": {"conditions": [condition("Ready", "False", "no route")]}}
    objects = {
        ("Kustomization", "ns", "perception"): kustomization("a", "a"),
        ("GitRepository", "ns", "demandops"): source,
    }
    health = FLUX.domain_health(PLACE, "b", objects, COMMITS)
    assert health == Health("waiting", "no route", "GitRepository ns/demandops", failing=True)


READY = condition("Ready", "True", "installed")


@pytest.mark.parametrize(
    ("objects", "state", "reason", "failing"),
    [
        ({}, "reconciled", "does not exist yet", False),
        ({"r": release()}, "reconciled", "is being installed", False),
        ({"r": release(READY, observed=1)}, "reconciled", "installed", False),
        ({"r": release(condition("Ready", "False", "no lidar"))}, "reconciled", "no lidar", True),
        ({"r": release(READY)}, "healthy", "", False),
        ({"r": release(READY), "d": deployment("x", of="od-edge")}, "healthy", "", False),
        ({"r": release(READY), "d": deployment("x", of="od-edge", availableReplicas=1)},
         "reconciled", "1 of 2 replicas are available", False),
        ({"r": release(READY), "d": deployment("x", of="od-edge", updatedReplicas=1)},
         "reconciled", "2 of 2 replicas are available", False),
        ({"r": release(READY), "d": deployment("x", of="od-edge", observedGeneration=2)},
         "reconciled", "available", False),
        ({"r": release(READY), "d": deployment("x", of="other", availableReplicas=0)},
         "healthy", "", False),
        ({"r": release(READY), "d": deployment("x", condition("ReplicaFailure", "True", "quota"),
                                               of="od-edge", availableReplicas=0)},
         "reconciled", "quota", True),
    ],
)  # fmt: skip
def test_a_service_is_healthy_when_helm_and_all_its_deployments_are(
    objects: dict[str, Any], state: str, reason: str, failing: bool
) -> None:
    keys = {"r": ("HelmRelease", "ns", "od-edge"), "d": ("Deployment", "ns", "x")}
    found = {keys[short]: item for short, item in objects.items()}
    health = FLUX.release_health(SERVICE, "b", found, COMMITS)
    assert (health.state, health.failing) == (state, failing)
    assert reason in health.reason


def test_a_connection_end_is_healthy_when_its_deployment_is() -> None:
    key = ("Deployment", "ns", "mqtt-a")
    assert FLUX.release_health(CLIENT, "b", {}, COMMITS).state == "reconciled"
    assert FLUX.release_health(CLIENT, "b", {key: deployment("mqtt-a")}, COMMITS).state == "healthy"
    assert (
        FLUX.release_health(
            CLIENT, "b", {key: deployment("mqtt-a", availableReplicas=0)}, COMMITS
        ).state
        == "reconciled"
    )


def test_a_removed_release_is_healthy_once_none_of_its_objects_is_left() -> None:
    helm = {("HelmRelease", "ns", "od-edge"): release(READY)}
    left = {("Deployment", "ns", "x"): deployment("x", of="od-edge")}
    assert FLUX.release_health(GONE, "b", helm, COMMITS).state == "reconciled"
    assert FLUX.release_health(GONE, "b", left, COMMITS).state == "reconciled"
    assert FLUX.release_health(GONE, "b", {}, COMMITS).state == "healthy"


def test_the_whole_is_as_far_as_its_least_and_a_failure_is_told_first() -> None:
    slow, failed = Health("reconciled", "slow"), Health("reconciled", "failed", failing=True)
    assert worst([Health("healthy"), slow, failed]) == failed
    assert worst([Health("healthy"), slow, Health("waiting")]) == Health("waiting")
    assert worst([]).state == "healthy"


def test_since_when_is_the_cluster_s_to_say() -> None:
    found = {("HelmRelease", "ns", "od-edge"): release(READY)}
    assert FLUX.last_transition(SERVICE, found) == "2026-05-04T12:00:00Z"
    assert FLUX.last_transition(CLIENT, found) == ""


@pytest.mark.parametrize(
    ("state", "level", "reached"),
    [
        ("waiting", "pushed", True),
        ("waiting", "reconciled", False),
        ("reconciled", "reconciled", True),
        ("reconciled", "healthy", False),
        ("healthy", "reconciled", True),
    ],
)
def test_levels_are_in_order(state: Any, level: Any, reached: bool) -> None:
    assert Health(state).reaches(level) is reached


def test_numbers_that_the_api_gives_as_null_are_those_that_it_leaves_out() -> None:
    found = deployment("mqtt-a", updatedReplicas=None, availableReplicas=None)
    found["metadata"]["generation"] = found["spec"]["replicas"] = None
    health = deployment_health(found)
    assert (health.state, health.reason) == ("reconciled", "0 of 1 replicas are available")


def source(fetched: str, asked: str, handled: str, **spec: Any) -> dict[str, Any]:
    status = {"artifact": {"revision": f"main@sha1:{fetched}"}, "lastHandledReconcileAt": handled}
    return {"metadata": {"annotations": {REQUESTED_AT: asked}}, "spec": spec, "status": status}


APPLIED = condition("Ready", "True", "applied")
APPLYING = condition("Ready", "Unknown", "building manifests")
REFUSED = condition("Ready", "False", "no such kind")


@pytest.mark.parametrize(
    ("fetches", "applies", "idle"),
    [
        (None, None, True),
        (source("b", "2", "2"), kustomization("b", "b", APPLIED), True),
        (source("b", "2", "2"), kustomization("a", "b", REFUSED), True),
        (source("a", "2", "1"), kustomization("a", "a", APPLIED), False),
        (source("a", "1", "1"), kustomization("a", "a", APPLIED), False),
        (source("b", "2", "2"), kustomization("a", "a", APPLIED), False),
        (source("b", "2", "2"), kustomization("a", "a", APPLYING), False),
        (source("b", "2", "2"), kustomization("b", "b", APPLYING), False),
        (source("b", "2", "2"), kustomization("", ""), False),
        (source("b", "2", "1", suspend=True), kustomization("a", "a", APPLIED), True),
    ],
    ids=[
        "not there", "applied", "refused", "asked", "not seen yet", "fetched", "begun", "ending",
        "new", "suspended",
    ],
)  # fmt: skip
def test_a_domain_is_idle_once_the_last_fetch_is_applied(
    fetches: dict[str, Any] | None, applies: dict[str, Any] | None, idle: bool
) -> None:
    objects = {("GitRepository", "ns", "demandops"): fetches} if fetches else {}
    objects |= {("Kustomization", "ns", "perception"): applies} if applies else {}
    assert Flux().is_idle(PLACE, objects, before="1") is idle


def test_a_domain_that_was_never_asked_to_fetch_is_idle() -> None:
    never = {"metadata": {}, "status": {"artifact": {"revision": "main@sha1:a"}}}
    objects = {
        ("GitRepository", "ns", "demandops"): never,
        ("Kustomization", "ns", "perception"): kustomization("a", "a", APPLIED),
    }
    assert Flux().is_idle(PLACE, objects, before=None)
    assert Flux().handled_request(PLACE, objects) == ""
