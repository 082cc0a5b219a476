"""The state of releases follows from Flux's objects, as the API gives them."""

from __future__ import annotations

from operator import itemgetter
from typing import Any

import pytest
from demandops.cluster.health import (
    REQUESTED_AT,
    ClusterDomain,
    Flux,
    Health,
    Target,
    health_reader,
    worst,
)

from tests.unit.cluster.cases import Case, Letters, condition, deployments, read_cases, told

COMMITS = Letters()
PLACE = ClusterDomain("c-its", "perception", "ns")
SERVICE = Target(PLACE, "od-edge", is_service=True)
CLIENT = Target(PLACE, "mqtt-a", is_service=False)
TARGETS = {
    "service": SERVICE,
    "client": CLIENT,
    "gone": Target(PLACE, "od-edge", is_service=True, wanted=False),
}
FLUX = health_reader(PLACE)
OVER = ("Kustomization", "ns", "perception")
SOURCE = ("GitRepository", "ns", "demandops")
HELM = ("HelmRelease", "ns", "od-edge")
CASES = read_cases(__file__, "flux.yaml")


def kustomization(applied: str = "", attempted: str = "", *conditions: Any) -> dict[str, Any]:
    status = {"lastAppliedRevision": applied and f"main@sha1:{applied}"}
    status["lastAttemptedRevision"] = attempted and f"main@sha1:{attempted}"
    spec = {"sourceRef": {"name": "demandops"}}
    return {"metadata": {}, "spec": spec, "status": status | {"conditions": list(conditions)}}


def release(*conditions: Any, observed: int = 2) -> dict[str, Any]:
    status = {"observedGeneration": observed, "conditions": list(conditions)}
    return {"metadata": {"generation": 2}, "status": status}


@pytest.mark.parametrize("case", CASES["domain"], ids=itemgetter("when"))
def test_an_access_domain_is_as_far_as_its_kustomization(case: Case) -> None:
    objects: dict[tuple[str, str, str], Any] = {}
    if "over" in case:
        over = case["over"]
        conditions = [condition(*one) for one in over.get("conditions", ())]
        objects[OVER] = kustomization(over["applied"], over["attempted"], *conditions)
    if "source" in case:
        conditions = [condition(*one) for one in case["source"]]
        objects[SOURCE] = {"metadata": {}, "status": {"conditions": conditions}}
    health = FLUX.domain_health(PLACE, "b", objects, COMMITS)
    assert told(health, case) == case


@pytest.mark.parametrize("case", CASES["release"], ids=itemgetter("when"))
def test_a_release_is_healthy_when_helm_and_all_its_deployments_are(case: Case) -> None:
    objects = deployments(case)
    if "helm" in case:
        conditions = [condition(*one) for one in case["helm"].get("conditions", ())]
        objects[HELM] = release(*conditions, observed=case["helm"].get("observed", 2))
    health = FLUX.release_health(TARGETS[case.get("of", "service")], "b", objects, COMMITS)
    assert told(health, case) == case


def test_the_whole_is_as_far_as_its_least_and_a_failure_is_told_first() -> None:
    slow, failed = Health("reconciled", "slow"), Health("reconciled", "failed", failing=True)
    assert worst([Health("healthy"), slow, failed]) == failed
    assert worst([Health("healthy"), slow, Health("waiting")]) == Health("waiting")
    assert worst([]).state == "healthy"


def test_since_when_is_the_cluster_s_to_say() -> None:
    found = {HELM: release(condition("Ready", "True"))}
    assert FLUX.last_transition(SERVICE, found) == "2026-05-04T12:00:00Z"
    assert FLUX.last_transition(CLIENT, found) == ""


def test_levels_are_in_order() -> None:
    levels: tuple[Any, ...] = ("pushed", "reconciled", "healthy")
    states: tuple[Any, ...] = ("waiting", "reconciled", "healthy")
    for reached, state in enumerate(states, start=1):
        found = [level for level in levels if Health(state).reaches(level)]
        assert found == [*levels[:reached]]


@pytest.mark.parametrize("case", CASES["idle"], ids=itemgetter("when"))
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
        objects[OVER] = kustomization(applied, attempted, condition("Ready", ready))
    assert Flux().is_idle(PLACE, objects, before="1") is case["idle"]


def test_a_domain_that_was_never_asked_to_fetch_is_idle() -> None:
    never = {"metadata": {}, "status": {"artifact": {"revision": "main@sha1:a"}}}
    objects = {SOURCE: never, OVER: kustomization("a", "a", condition("Ready", "True", "applied"))}
    assert Flux().is_idle(PLACE, objects, before=None)
    assert Flux().handled_request(PLACE, objects) == ""
