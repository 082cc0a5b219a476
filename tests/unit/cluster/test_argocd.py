"""The state of releases follows from Argo CD's objects, as the API gives them."""

from __future__ import annotations

from operator import itemgetter
from typing import Any

import pytest
from demandops.cluster.health import (
    ClusterDomain,
    ObjectSelector,
    Target,
    health_reader,
)

from tests.unit.cluster.cases import Case, Letters, condition, deployments, read_cases, told

URL = "https://git.example/fleet.git"
COMMITS = Letters()
PLACE = ClusterDomain(
    "c-its", "perception", "ns", ObjectSelector("Application", "argocd", "demandops-perception")
)
ARGOCD = health_reader(PLACE)
SERVICE = Target(PLACE, "od-edge", is_service=True)
CLIENT = Target(PLACE, "mqtt-a", is_service=False)
TARGETS = {
    "service": SERVICE,
    "client": CLIENT,
    "gone": Target(PLACE, "od-edge", is_service=True, wanted=False),
}
FOLDER = {"repoURL": URL, "path": "clusters/c-its/perception", "targetRevision": "main"}
CHART = "appdefs/od/charts/od"
OVER = ("Application", "argocd", "demandops-perception")
CHILD = ("Application", "ns", "od-edge")
AT = "2026-05-04T12:00:00Z"
CASES = read_cases(__file__, "argocd.yaml")


def source(**values: Any) -> dict[str, Any]:
    helm = {"releaseName": "od-edge", "valuesObject": values}
    return {"repoURL": URL, "path": CHART, "targetRevision": "main", "helm": helm}


def nested(depth: int) -> list[Any]:
    return [nested(depth - 1)] if depth else []


SOURCES: dict[str, dict[str, Any]] = {
    "folder": FOLDER,
    "elsewhere": {**FOLDER, "path": "clusters/x"},
    "new": source(inputs=2),
    "old": source(inputs=1),
    "sparse": {**source(inputs=[], image=None, port=1), "directory": {"recurse": True}},
    "written out": {**source(port=1), "directory": {"recurse": True, "jsonnet": {}}},
    "deep": source(image=nested(900)),
    "registry": {"repoURL": "oci://r.example/od", "path": ".", "targetRevision": "1.2.0"},
}


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
    """Return an Application with the source ``wanted``, which was compared if ``sync`` is set."""
    status: dict[str, Any] = {"conditions": list(conditions), "resources": list(resources)}
    status["health"] = {"status": health, "lastTransitionTime": AT}
    if sync:
        against = {"source": wanted if compared is None else compared}
        status["sync"] = {"status": sync, "revision": at, "comparedTo": against}
    if operation:
        status["operationState"] = operation
    return {"metadata": {"name": "x"}, "spec": {"source": wanted}, "status": status}


def synced(phase: str, revision: str, message: str = "", **more: Any) -> dict[str, Any]:
    """Return the ``operationState`` of a sync from the source ``of``, by default the folder."""
    result = {"revision": revision, "source": more.pop("of", FOLDER)}
    result["resources"] = more.pop("resources", [])
    asked = {"sync": {"revision": revision, "resources": more.pop("only", None)}}
    return {
        "phase": phase, "message": message, "syncResult": result, "operation": asked, **more
    }  # fmt: skip


def described(default: str, fields: dict[str, Any]) -> dict[str, Any]:
    """Return the Application that a case describes."""
    fields, wanted = {**fields}, SOURCES[fields.get("source", default)]
    fields.pop("source", None)
    is_deleted = fields.pop("deleted", False)
    if "compared" in fields:
        fields["compared"] = SOURCES[fields["compared"]]
    if "operation" in fields:
        operation = {**fields["operation"]}
        operation["of"] = SOURCES[operation.get("of", default)]
        fields["operation"] = synced(**operation)
    fields["conditions"] = [
        condition(kind, "", text) for kind, text in fields.get("conditions", ())
    ]
    fields["resources"] = [
        {"group": "apps", "kind": "Deployment", "namespace": "ns", "name": name}
        for name in fields.get("resources", ())
    ]
    made = application(wanted, **fields)
    made["metadata"] |= {"deletionTimestamp": AT} if is_deleted else {}
    return made


@pytest.mark.parametrize("case", CASES["domain"], ids=itemgetter("when"))
def test_an_access_domain_is_as_far_as_the_application_over_its_folder(case: Case) -> None:
    objects = {OVER: described("folder", case["over"])} if "over" in case else {}
    health = ARGOCD.domain_health(PLACE, "b", objects, COMMITS)
    assert told(health, case) == case
    assert health.object in ("", "Application argocd/demandops-perception")


@pytest.mark.parametrize("case", CASES["release"], ids=itemgetter("when"))
def test_a_release_is_healthy_when_it_is_synced_as_it_stands_now_and_all_is_there(
    case: Case,
) -> None:
    objects = {OVER: application(FOLDER, sync="Synced", at="b"), **deployments(case)}
    if "child" in case:
        objects[CHILD] = described("new", case["child"])
    history = Letters([case["changing"]] if "changing" in case else [])
    health = ARGOCD.release_health(TARGETS[case.get("of", "service")], "b", objects, history)
    assert told(health, case) == case


def test_applied_commit_and_last_transition_come_from_the_applications_in_the_cluster() -> None:
    objects = {OVER: application(FOLDER, sync="Synced", at="b"), CHILD: application(source())}
    assert ARGOCD.applied_commit(PLACE, objects) == "b"
    assert ARGOCD.applied_commit(PLACE, {}) == ""
    succeeded = synced("Succeeded", "b")
    under_way = application(FOLDER, sync="OutOfSync", at="c", operation=succeeded)
    assert ARGOCD.applied_commit(PLACE, {OVER: under_way}) == "b"
    assert ARGOCD.last_transition(SERVICE, objects) == AT
    assert ARGOCD.last_transition(CLIENT, objects) == ""


def test_only_one_object_of_argo_cds_namespace_is_read() -> None:
    """The generator may lack the right to read other objects in Argo CD's namespace."""
    assert ARGOCD.objects_to_watch(PLACE)[0] == ObjectSelector(*OVER)
