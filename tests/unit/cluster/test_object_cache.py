"""What is read and watched in a cluster over real HTTP, and a cluster that cannot be reached."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from demandops.base import strict_yaml
from demandops.cluster import rollouts
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.health import ClusterDomain, ObjectSelector, Target
from demandops.cluster.nodes import ClusterNodes
from demandops.cluster.rollouts import RolloutWatcher
from demandops.cluster.watches import ConfigMapWatch, ObjectCache
from demandops.decide.decision import decide
from demandops.decide.discovery import ClusterNode
from demandops.model.config.config import Config

from tests.golden.cases import requests_of, start
from tests.kit import goals
from tests.kit.clock import Clock
from tests.kit.cluster import KubeApi, kube_api
from tests.kit.http import Answer, Call, kubeconfig, serving
from tests.kit.limits import PATIENCE_S
from tests.kit.memory import NOW, MemoryRepo
from tests.kit.rig import wait_until
from tests.unit.cluster.cases import Letters

OVER = ObjectSelector("Application", "argocd", "demandops-perception")
CHILDREN = ObjectSelector("Application", "perception")
DEPLOYMENTS = ObjectSelector("Deployment", "perception")
AWAY = "http://127.0.0.1:1"


def access(folder: Path, url: str = AWAY) -> ClusterAccess:
    return ClusterAccess(kubeconfig=kubeconfig(folder, url))


@dataclass
class Api:
    """An API server with an Application in each namespace; it records the paths of calls."""

    cache: ObjectCache
    asked: list[str] = field(default_factory=list)
    refused: str = "nothing"


@pytest.fixture
def api(tmp_path: Path) -> Iterator[Api]:
    def answer(call: Call) -> Answer:
        api.asked.append(call.path)
        item = {"metadata": {"name": "one", "resourceVersion": "1"}}
        listed = {"metadata": {"resourceVersion": "1"}, "items": [item]}
        return Answer.json(listed, 403 if api.refused in call.path else 200)

    with serving(answer) as server:
        api = Api(ObjectCache("c-its", access(tmp_path, server.url), lambda: None))
        yield api


def test_one_object_is_asked_for_by_its_name(api: Api) -> None:
    read = api.cache
    why = read.why_unavailable("perception", "mqtt-edge")
    assert why == "", "of a Deployment that is not known"
    read.read_once([OVER, CHILDREN])
    over, children = api.asked
    assert over.endswith(
        "/namespaces/argocd/applications?fieldSelector=metadata.name%3Ddemandops-perception"
    )
    assert children.endswith("/namespaces/perception/applications")
    found = {("Application", namespace, "one") for namespace in ("argocd", "perception")}
    assert set(read.objects()) == found


def test_what_may_not_be_read_is_told_and_the_rest_is_known(api: Api) -> None:
    api.refused = "/argocd/"
    read = api.cache
    read.read_once([OVER, CHILDREN])
    assert read.why_unknown([OVER]) == "applications in argocd: Forbidden"
    assert read.why_unknown([CHILDREN]) == ""
    assert read.why_unknown([DEPLOYMENTS]) == "some objects have not been read yet"


def test_a_cluster_that_is_away_is_asked_once(tmp_path: Path) -> None:
    read = ObjectCache("away", access(tmp_path), lambda: None)
    read.read_once([OVER, CHILDREN])
    assert read.why_unknown([OVER]) == "Connection refused"
    assert read.why_unknown([CHILDREN]) == read.why_unknown([OVER])


def test_since_when_a_cluster_cannot_be_read_is_known_until_it_can(api: Api) -> None:
    api.refused = "perception"
    cache = api.cache
    cache.watch([DEPLOYMENTS])
    wait_until(lambda: cache.unread_since, "the first answer has come")
    target = Target(ClusterDomain("c-its", "d", "perception"), "r", is_service=True)
    (status,) = rollouts.statuses([target], "a" * 40, {"c-its": cache}, Letters(), lambda *_: None)
    assert status.since == cache.unread_since
    api.refused = "nothing"
    wait_until(lambda: not cache.unread_since, "it is read again")
    cache.close()


def test_a_watch_that_lags_takes_nothing_back(tmp_path: Path) -> None:
    def item(name: str, version: int) -> dict[str, Any]:
        return {"metadata": {"name": name, "resourceVersion": str(version)}}

    is_over = Event()

    def events() -> Iterator[bytes]:
        for seen in (item("one", 9), item("two", 11)):
            yield json.dumps({"type": "MODIFIED", "object": seen}).encode() + b"\n"
        is_over.wait(PATIENCE_S)

    def answer(call: Call) -> Answer:
        if "watch=" in call.path:
            return Answer(headers={"Content-Type": "application/json"}, body=events())
        return Answer.json({"metadata": {"resourceVersion": "8"}, "items": [item("one", 10)]})

    with serving(answer) as server:
        cache = ObjectCache("c-its", access(tmp_path, server.url), lambda: None)
        cache.watch([DEPLOYMENTS])
        wait_until(lambda: len(cache.objects()) == 2, "both events have come")
        one = cache.objects()["Deployment", "perception", "one"]
        assert one["metadata"]["resourceVersion"] == "10"
        cache.refresh([DEPLOYMENTS])
        assert len(cache.objects()) == 1, "what is listed no longer is gone"
        cache.close()
        is_over.set()


def test_a_cluster_that_is_away_is_the_reason_at_the_end_of_the_time(tmp_path: Path) -> None:
    clock = Clock(NOW)
    status = RolloutWatcher({"away": access(tmp_path)}, Letters(), runtime=clock)
    try:
        target = Target(ClusterDomain("away", "d", "ns"), "r", is_service=True)
        late = status.follow("a" * 40, [target], "healthy", timeout=60)
        soon = status.follow("a" * 40, [target], "healthy", timeout=10)
        clock.pass_(11)
        health = soon.result(PATIENCE_S)
        assert not late.done()
        clock.pass_(60)
        assert late.result(PATIENCE_S).state == "waiting"
        assert (health.state, health.object) == ("waiting", "cluster away")
        assert health.reason.startswith("cannot be read: ")
        # a demand without a target on that cluster does not wait for the cluster
        without = status.follow("a" * 40, [], "healthy", timeout=60)
        assert without.result(PATIENCE_S).state == "healthy"
        followed = status.follow("a" * 40, [target], "reconciled", timeout=600)
    finally:
        status.close()
    assert followed.result(PATIENCE_S).state == "waiting", "closing answers what is followed"


def test_clusters_without_a_kubeconfig_tell_nothing() -> None:
    status = RolloutWatcher({"w": ClusterAccess(receiver="https://h/hook")}, Letters())
    asked = [ClusterDomain("w", "d", "n"), ClusterDomain("x", "d", "n")]
    assert status.why_unreachable(asked) == "no access to cluster w, x"
    assert status.why_unreachable([]) == ""
    status.close()


def test_what_is_healthy_is_read_again_and_what_failed_before_is_told(tmp_path: Path) -> None:
    clock, told = Clock(NOW), list[str]()
    target = Target(ClusterDomain("c", "d", "ns"), "r", is_service=False)
    key = ("Deployment", "ns", "r")
    with kube_api() as api:
        api.flux("ns", "d", "a")
        api.deployment("ns", "r")
        status = RolloutWatcher({"c": access(tmp_path, api.url)}, Letters(), runtime=clock)
        follow = partial(status.follow, "a", [target], "healthy")
        assert follow(60).result(PATIENCE_S).state == "healthy"
        api._items["deployments", "ns", "r"]["status"]["availableReplicas"] = 0  # no watch tells it
        assert follow(-1).result(PATIENCE_S).reason == "0 of 1 replicas are available"
        late = follow(60, lambda state, text: told.append(state))
        failed = {"type": "ReplicaFailure", "status": "True", "message": "no room"}
        api.put("deployments", "ns", "r", {"conditions": [failed]})
        wait_until(lambda: "failing" in told, "the failure is told")
        api.deployment("ns", "r", available=0)
        cache = status._caches["c"]
        wait_until(lambda: "conditions" not in cache.objects()[key]["status"], "it is retried")
        clock.pass_(61)
        reason = "0 of 1 replicas are available; before: no room"
        assert late.result(PATIENCE_S).reason == reason
        status.close()


ITEM = {"metadata": {"name": "of-params", "resourceVersion": "1"}, "data": {"params.yml": "a"}}
NAME = "ConfigMap perception/of-params"


def test_data_of_a_deleted_config_map_stay_valid(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    items: list[list[Any]] = [[], [ITEM], []]
    is_read, passed_on = Event(), list[Mapping[str, str]]()

    def answer(call: Call) -> Answer:
        if "watch=" in call.path:
            gone = {"type": "DELETED", "object": ITEM}
            return Answer.json(gone if len(items) == 1 else {})
        if not items:
            is_read.set()
            return Answer.json({"reason": "over"}, 503)
        return Answer.json({"metadata": {"resourceVersion": "1"}, "items": items.pop(0)})

    with serving(answer) as server:
        config = kubeconfig(tmp_path, server.url)
        watch = ConfigMapWatch(
            "perception", "of-params", lambda data: passed_on.append({**data}), config
        )
        assert is_read.wait(PATIENCE_S)
        watch.close()
    assert passed_on == [{"params.yml": "a"}]
    told = [text for text in caplog.messages if text.startswith(NAME) and "retrying" not in text]
    assert told == [
        f"{NAME} does not exist yet",
        f"{NAME} is gone; its last data stay valid",
    ]


@pytest.mark.parametrize(
    ("case", "application"),
    [
        ("experiment", None),
        ("argocd-experiment", ObjectSelector("Application", "argocd", "demandops-perception")),
    ],
)
def test_a_rollout_target_names_its_argo_cd_application_or_none_for_flux(
    case: str, application: ObjectSelector | None
) -> None:
    state, files = start(case)
    goal = strict_yaml.load(requests_of(case)[0].read_text())
    found = rollouts.targets_of_decision(state, decide(state, goal, NOW, files.get))
    assert {target.domain.application for target in found} == {application}
    assert {target.is_service for target in found} == {True, False}


def test_a_demand_waits_for_no_release_that_only_others_need() -> None:
    def join(cloud: goals.Topic) -> goals.Goal:
        return goals.goal([goals.application(who=[cloud[1]], clouds=[cloud])], id=cloud[1])

    def followed(goal: goals.Goal) -> dict[str, bool]:
        before = repo.state
        targets = rollouts.targets_of_decision(before, repo.send(goal))
        services = (target for target in targets if not target.name.startswith("mqtt-"))
        return {target.name: target.wanted for target in services}

    repo, fusion = MemoryRepo(), "of-edge-object-detection-fusion-cf7e0180a8bb"
    vehicle, station = join(goals.CLOUD), join(goals.STATION_CLOUD)
    repo.send(vehicle)
    own = {fusion: True, "od-edge-station00": True}
    assert followed(station) == own
    assert followed(station) == own, "the demand was booked before"
    assert followed(vehicle | {"shutdown": True}) == {fusion: True, "od-edge-vehicle00": False}


# ---- the nodes of a cluster ----


# the path of all nodes is /api/v1/nodes
NODES = ("nodes", "v1")


def config(clusters: str = "{name: c-its, nodes: from-cluster}") -> Config:
    text = f"apiVersion: demandops/v1\nkind: Clusters\nclusters: [{clusters}]\n"
    return MemoryRepo({"inventory/clusters.yaml": text}).config


class Told:
    """The nodes of a cluster, and how often a change was told."""

    def __init__(self, folder: Path, url: str) -> None:
        self.times = 0
        self.all = ClusterNodes({"c-its": access(folder, url)}, self._tell)

    def _tell(self) -> None:
        self.times += 1

    def by_name(self) -> dict[str, ClusterNode]:
        return {node.name: node for node in self.all.of(config()).get("c-its", ())}


@pytest.fixture
def kube() -> Iterator[KubeApi]:
    with kube_api() as made:
        yield made


@pytest.fixture
def told(kube: KubeApi, tmp_path: Path) -> Iterator[Told]:
    made = Told(tmp_path, kube.url)
    yield made
    made.all.close()


def put(kube: KubeApi, name: str, *, ready: str = "True", **more: Any) -> None:
    labels = {"node_id": name} | more.pop("labels", {})
    status = {"allocatable": {"cpu": "4"}, "conditions": [{"type": "Ready", "status": ready}]}
    metadata = {"labels": labels, "managedFields": more.pop("fields", [])}
    kube.put(*NODES, name, status, metadata=metadata, **more)


def test_nodes_come_change_and_go(kube: KubeApi, told: Told) -> None:
    put(kube, "bus0")
    put(kube, "bus1")
    wait_until(lambda: len(told.by_name()) == 2, "the list")
    assert told.by_name()["bus0"] == ClusterNode(
        "bus0", {"node_id": "bus0"}, {"cpu": "4"}, is_cordoned=False, writers={}
    )
    fields = [
        {"manager": "kubelet", "fieldsV1": {"f:status": {}}},
        {"manager": "kubectl-cordon", "fieldsV1": {"f:spec": {"f:unschedulable": {}}}},
        {
            "manager": "kubectl-label",
            "fieldsV1": {"f:metadata": {"f:labels": {".": {}, "f:demandops/type": {}}}},
        },
    ]
    cordoned = {"spec": {"unschedulable": True}, "labels": {"demandops/type": "bus"}}
    put(kube, "bus0", fields=fields, **cordoned)
    wait_until(lambda: told.by_name()["bus0"].is_cordoned, "the cordon")
    writers = told.by_name()["bus0"].writers
    assert writers[""] == "kubectl-cordon"
    assert writers["demandops/type"] == "kubectl-label"
    kube.delete(*NODES, "bus1")
    wait_until(lambda: [*told.by_name()] == ["bus0"], "the deletion")
    assert kube.reads == 1


def test_what_no_decision_sees_is_not_told(kube: KubeApi, told: Told) -> None:
    put(kube, "bus0")
    wait_until(lambda: told.by_name() and told.times, "the list")
    before = told.times
    for ready in ("False", "Unknown", "True"):
        put(kube, "bus0", ready=ready)
    put(kube, "bus1")  # a watch tells all in order
    wait_until(lambda: "bus1" in told.by_name(), "the second node")
    wait_until(lambda: told.times > before, "it is told, after it is known")
    assert told.times == before + 1


def test_only_the_nodes_that_are_asked_for_are_read(tmp_path: Path) -> None:
    asked = list[str]()

    def answer(call: Call) -> Answer:
        asked.append(call.path)
        more = {"continue": "second"} if "continue=" not in call.path else {}
        name = "bus1" if not more else "bus0"
        item = {"metadata": {"name": name, "resourceVersion": "1", "labels": {"node_id": name}}}
        return Answer.json({"metadata": {"resourceVersion": "1", **more}, "items": [item]})

    asks = "{name: c-its, nodes: from-cluster, discovery: {selector: {fleet: public, age: new}}}"
    with serving(answer) as server:
        told = Told(tmp_path, server.url)
        wait_until(lambda: told.all.of(config(asks)).get("c-its"), "the list")
        nodes = told.all.of(config(asks))["c-its"]
        # nothing is known of what another selector asks for
        told.all.of(config("{name: c-its}"))
        assert told.all.of(config("{name: c-its}")) == {}
        told.all.close()
    assert [node.name for node in nodes] == ["bus0", "bus1"], "of two pages"
    assert "labelSelector=node_id%2Cage%3Dnew%2Cfleet%3Dpublic" in asked[0]


def test_a_cluster_that_cannot_be_read_has_no_nodes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    told = Told(tmp_path, AWAY)
    assert told.by_name() == {}
    why = "the nodes of cluster 'c-its' cannot be read (Connection refused) and stay as they are"
    wait_until(lambda: why in caplog.text, "the warning")
    assert told.all.of(config()) == {}
    told.all.close()


def test_a_cluster_without_a_kubeconfig_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    nodes = ClusterNodes({}, lambda: None)
    for _ in range(2):
        assert nodes.of(config()) == {}
    assert caplog.text.count("--clusters has no kubeconfig for it") == 1
