"""The state of releases follows from Argo CD's objects, as the API gives them."""

from __future__ import annotations

from typing import Any

import pytest
from demandops.cluster.health import (
    ClusterDomain,
    Health,
    ObjectName,
    ObjectSelector,
    Target,
    health_reader,
)

from tests.kit.cluster import Letters, condition, deployment

URL = "https://git.example/fleet.git"
COMMITS = Letters()
PLACE = ClusterDomain("c-its", "perception", "ns", ObjectName("argocd", "demandops-perception"))
ARGOCD = health_reader(PLACE)
SERVICE = Target(PLACE, "od-edge", is_service=True)
CLIENT = Target(PLACE, "mqtt-a", is_service=False)
GONE = Target(PLACE, "od-edge", is_service=True, wanted=False)
FOLDER = {"repoURL": URL, "path": "clusters/c-its/perception", "targetRevision": "main"}
CHART = "appdefs/od/charts/od"
OVER = ("Application", "argocd", "demandops-perception")
CHILD = ("Application", "ns", "od-edge")
AT = "2026-05-04T12:00:00Z"


def source(**values: Any) -> dict[str, Any]:
    helm = {"releaseName": "od-edge", "valuesObject": values}
    return {"repoURL": URL, "path": CHART, "targetRevision": "main", "helm": helm}


def application(
    wanted: dict[str, Any],
    *,
    sync: str = "",
    at: str = "",
    compared: dict[str, Any] | None = None,
    operation: dict[str, Any] | None = None,
    conditions: tuple[dict[str, str], ...] = (),
    health: str = "Healthy",
    resources: tuple[dict[str, str], ...] = (),
) -> dict[str, Any]:
    """Return an Application whose spec has the source ``wanted``.

    If ``sync`` is set, the status names the source to which Argo CD compared the cluster:
    ``compared`` or, by default, ``wanted``.
    """
    status: dict[str, Any] = {"conditions": list(conditions), "resources": list(resources)}
    status["health"] = {"status": health, "lastTransitionTime": AT}
    if sync:
        against = {"source": wanted if compared is None else compared}
        status["sync"] = {"status": sync, "revision": at, "comparedTo": against}
    if operation:
        status["operationState"] = operation
    return {"metadata": {"name": "x"}, "spec": {"source": wanted}, "status": status}


def synced(phase: str, revision: str, message: str = "", **more: Any) -> dict[str, Any]:
    """Return the ``operationState`` of a sync from ``source``, by default from ``FOLDER``."""
    result = {"revision": revision, "source": more.pop("source", FOLDER)}
    result["resources"] = more.pop("resources", [])
    asked = {"sync": {"revision": revision, "resources": more.pop("only", None)}}
    return {
        "phase": phase, "message": message, "syncResult": result, "operation": asked, **more
    }  # fmt: skip


def over(**status: Any) -> dict[str, Any]:
    return application(FOLDER, **status)


FAILED = {"kind": "Application", "name": "od-edge", "status": "SyncFailed", "message": "forbidden"}


@pytest.mark.parametrize(
    ("found", "state", "reason", "failing"),
    [
        (None, "waiting", "does not exist; apply bootstrap/c-its.yaml to the cluster", False),
        (over(), "waiting", "has not applied the commit yet", False),
        (over(sync="Synced", at="a"), "waiting", "has not applied the commit yet", False),
        (over(sync="Synced", at="b"), "reconciled", "", False),
        (over(sync="Synced", at="c"), "reconciled", "", False),
        # the commit was compared, but not applied
        (over(sync="OutOfSync", at="b"), "waiting", "has not applied the commit yet", False),
        # Synced, but the path is that of an older bootstrap file
        (over(sync="Synced", at="b", compared={**FOLDER, "path": "clusters/x"}), "waiting",
         "has not applied the commit yet", False),
        # Argo CD already compares a newer commit
        (over(sync="OutOfSync", at="c", operation=synced("Succeeded", "b")), "reconciled", "",
         False),
        (over(sync="OutOfSync", at="b", operation=synced("Succeeded", "a")), "waiting",
         "has not applied the commit yet", False),
        (over(sync="OutOfSync", at="b", operation=synced("Running", "b")), "waiting",
         "has not applied the commit yet", False),
        # a person has synced a single object
        (over(sync="OutOfSync", at="b", operation=synced("Succeeded", "b", only=[{"name": "x"}])),
         "waiting", "has not applied the commit yet", False),
        (over(sync="OutOfSync", at="b", operation=synced("Failed", "b", "one failed")), "waiting",
         "one failed", True),
        # Argo CD retries the sync without end, and reports it as Running
        (over(sync="OutOfSync", at="b", operation=synced("Running", "b", "one failed. Retrying",
              finishedAt=AT, resources=[FAILED])),
         "waiting", "one failed. Retrying; Application od-edge: forbidden", True),
        (over(sync="OutOfSync", at="a", operation=synced("Running", "a", "no", finishedAt=AT)),
         "waiting", "has not applied the commit yet; Argo CD reports for a: no", False),
        (over(sync="Unknown", at="", conditions=(condition("ComparisonError", "", "no route"),)),
         "waiting", "ComparisonError: no route", True),
        (over(sync="Synced", at="a", conditions=(condition("OrphanedResourceWarning", "", "w"),)),
         "waiting", "has not applied the commit yet", False),
    ],
)  # fmt: skip
def test_an_access_domain_is_as_far_as_the_application_over_its_folder(
    found: dict[str, Any] | None, state: str, reason: str, failing: bool
) -> None:
    health = ARGOCD.domain_health(PLACE, "b", {OVER: found} if found else {}, COMMITS)
    assert (health.state, health.failing) == (state, failing)
    assert health.reason.startswith(reason)
    assert health.object in ("", "Application argocd/demandops-perception")


NEW, OLD = source(inputs=2), source(inputs=1)
MADE = ({"group": "apps", "kind": "Deployment", "namespace": "ns", "name": "x"},)
BAD = condition("Progressing", "False", "timed out")


@pytest.mark.parametrize(
    ("child", "made", "state", "reason", "failing"),
    [
        (None, None, "reconciled", "does not exist yet", False),
        (application(NEW), None, "reconciled", "has not been compared yet", False),
        (application(NEW, sync="Synced", at="b"), None, "healthy", "", False),
        # the reported health dates from before the change
        (application(NEW, sync="Synced", at="b", compared=OLD), None, "reconciled",
         "has not been compared with its current spec yet", False),
        (application(NEW, sync="OutOfSync", at="b"), None, "reconciled", "is being synced", False),
        (application(NEW, sync="OutOfSync", at="b", operation=synced("Running", "b", "waiting for "
                     "healthy state", source=NEW)), None, "reconciled", "waiting for healthy",
         False),
        (application(NEW, sync="Synced", at="b", health="Progressing"), None, "reconciled",
         "its health is Progressing", False),
        (application(NEW, sync="Synced", at="b", health="Degraded"), None, "reconciled",
         "its health is Degraded", True),
        (application(NEW, sync="Synced", at="b", health="Missing"), None, "reconciled",
         "its health is Missing", False),
        # the health of the Deployments counts, because it is more exact and comes sooner
        (application(NEW, sync="Synced", at="b", resources=MADE), None, "reconciled",
         "does not exist yet", False),
        (application(NEW, sync="Synced", at="b", resources=MADE), deployment("x"), "healthy", "",
         False),
        (application(NEW, sync="Synced", at="b", resources=MADE),
         deployment("x", availableReplicas=1), "reconciled", "1 of 2 replicas", False),
        (application(NEW, sync="Synced", at="b", resources=MADE, health="Degraded"),
         deployment("x", BAD, availableReplicas=1), "reconciled", "timed out", True),
        (application(NEW, sync="Unknown", conditions=(condition("ComparisonError", "", "no chart"),)
                     ), None, "reconciled", "ComparisonError: no chart", True),
        (application(NEW, sync="OutOfSync", at="b", operation=synced("Failed", "b", "denied",
                     source=NEW)), None, "reconciled", "denied", True),
        # a failure of the previous spec counts only while Argo CD still retries that spec
        (application(NEW, sync="OutOfSync", at="b", operation=synced("Failed", "b", "denied",
                     source=OLD)), None, "reconciled", "denied", False),
        (application(NEW, sync="OutOfSync", at="b", operation=synced("Running", "b", "denied",
                     source=OLD, finishedAt=AT)), None, "reconciled",
         "its previous spec is still being retried: denied", True),
    ],
)  # fmt: skip
def test_a_service_is_healthy_when_it_is_synced_as_it_stands_now_and_all_is_there(
    child: dict[str, Any] | None,
    made: dict[str, Any] | None,
    state: str,
    reason: str,
    failing: bool,
) -> None:
    objects = {OVER: over(sync="Synced", at="b"), CHILD: child, ("Deployment", "ns", "x"): made}
    found = {key: item for key, item in objects.items() if item}
    health = ARGOCD.release_health(SERVICE, "b", found, COMMITS)
    assert (health.state, health.failing) == (state, failing)
    assert health.reason.startswith(reason)


def test_what_argo_cd_leaves_out_or_writes_out_makes_no_other_source() -> None:
    wanted = {**source(inputs=[], image=None, port=1), "directory": {"recurse": True}}
    compared = {**source(port=1), "directory": {"recurse": True, "jsonnet": {}}}
    child = application(wanted, sync="Synced", at="b", compared=compared)
    objects = {OVER: over(sync="Synced", at="b"), CHILD: child}
    assert ARGOCD.release_health(SERVICE, "b", objects, COMMITS).state == "healthy"


def test_a_source_that_is_nested_very_deeply_is_another_source() -> None:
    deep: Any = "x"
    for _ in range(900):
        deep = [deep]
    child = application(source(), sync="Synced", at="b", compared=source(image=deep))
    objects = {OVER: over(sync="Synced", at="b"), CHILD: child}
    assert ARGOCD.release_health(SERVICE, "b", objects, COMMITS).state != "healthy"


@pytest.mark.parametrize(
    ("at", "changing", "state"),
    [
        ("a", [], "healthy"),
        ("a", [("b", "appdefs/other")], "healthy"),
        ("a", [("b", CHART)], "reconciled"),
        ("b", [("b", CHART)], "healthy"),
        ("c", [("b", CHART)], "healthy"),
    ],
)
def test_a_chart_that_changed_in_its_folder_is_waited_for(
    at: str, changing: list[tuple[str, str]], state: str
) -> None:
    """The Application's source stays the same, so only the synced commit tells which chart runs."""
    objects = {
        OVER: over(sync="Synced", at="b"),
        CHILD: application(NEW, sync="Synced", at=at),
    }
    health = ARGOCD.release_health(SERVICE, "b", objects, Letters(changing))
    assert health.state == state
    assert health.reason == ("" if state == "healthy" else "has not applied the commit's chart yet")


def test_a_chart_of_a_registry_has_its_version_in_the_source() -> None:
    chart = {"repoURL": "oci://r.example/od", "path": ".", "targetRevision": "1.2.0"}
    objects = {
        OVER: over(sync="Synced", at="b"),
        CHILD: application(chart, sync="Synced", at="1.2.0"),
    }
    history = Letters([("b", ".")])
    assert ARGOCD.release_health(SERVICE, "b", objects, history).state == "healthy"


def test_a_connection_end_is_healthy_when_its_deployment_is() -> None:
    key = ("Deployment", "ns", "mqtt-a")
    assert ARGOCD.release_health(CLIENT, "b", {}, COMMITS).state == "reconciled"
    assert (
        ARGOCD.release_health(CLIENT, "b", {key: deployment("mqtt-a")}, COMMITS).state == "healthy"
    )


def test_a_removed_release_is_healthy_once_none_of_its_objects_is_left() -> None:
    child = application(NEW, sync="Synced", at="b")
    left = deployment("x")
    left["metadata"]["annotations"] = {
        "argocd.argoproj.io/tracking-id": "ns_od-edge:apps/Deployment:ns/x"
    }
    other = deployment("y")
    other["metadata"]["annotations"] = {
        "argocd.argoproj.io/tracking-id": "ns_od-edge-2:apps/Deployment:ns/y"
    }
    removing = Health("reconciled", "is still being removed", "Application ns/od-edge")
    assert ARGOCD.release_health(GONE, "b", {CHILD: child}, COMMITS) == removing
    assert ARGOCD.release_health(GONE, "b", {("Deployment", "ns", "x"): left}, COMMITS) == removing
    found = {("Deployment", "ns", "y"): other}
    assert ARGOCD.release_health(GONE, "b", found, COMMITS) == Health("healthy")
    child["status"]["conditions"] = [condition("DeletionError", "", "forbidden")]
    health = ARGOCD.release_health(GONE, "b", {CHILD: child}, COMMITS)
    assert health.failing and health.reason.endswith("DeletionError: forbidden")


def test_an_application_under_deletion_does_not_count_as_the_wanted_one() -> None:
    child = application(NEW, sync="Synced", at="b")
    child["metadata"]["deletionTimestamp"] = AT
    health = ARGOCD.release_health(SERVICE, "b", {CHILD: child}, COMMITS)
    assert health.state == "reconciled" and "created again" in health.reason


def test_applied_commit_and_last_transition_come_from_the_applications_in_the_cluster() -> None:
    objects = {OVER: over(sync="Synced", at="b"), CHILD: application(NEW)}
    assert ARGOCD.applied_commit(PLACE, objects) == "b"
    assert ARGOCD.applied_commit(PLACE, {}) == ""
    under_way = over(sync="OutOfSync", at="c", operation=synced("Succeeded", "b"))
    assert ARGOCD.applied_commit(PLACE, {OVER: under_way}) == "b"
    assert ARGOCD.last_transition(SERVICE, objects) == AT
    assert ARGOCD.last_transition(CLIENT, objects) == ""


def test_only_one_object_of_argo_cds_namespace_is_read() -> None:
    """The generator may lack the right to read other objects in Argo CD's namespace."""
    assert ARGOCD.objects_to_watch(PLACE)[0] == ObjectSelector(
        "Application", "argocd", "demandops-perception"
    )
