"""What is watched of the nodes of a cluster, over real HTTP, and one that cannot be reached."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.nodes import ClusterNodes
from demandops.decide.discovery import ClusterNode
from demandops.model.config.config import Config

from tests.kit.cluster import KubeApi, kube_api
from tests.kit.http import Answer, Call, kubeconfig, serving
from tests.kit.memory import MemoryRepo
from tests.kit.rig import wait_until

# the path of all nodes is /api/v1/nodes
NODES = ("nodes", "v1")


def config(clusters: str = "{name: c-its, nodes: from-cluster}") -> Config:
    text = f"apiVersion: demandops/v1\nkind: Clusters\nclusters: [{clusters}]\n"
    return MemoryRepo({"inventory/clusters.yaml": text}).config


class Told:
    """The nodes of a cluster, and how often a change was told."""

    def __init__(self, folder: Path, url: str) -> None:
        access = ClusterAccess(kubeconfig=kubeconfig(folder, url))
        self.times = 0
        self.all = ClusterNodes({"c-its": access}, self._tell)

    def _tell(self) -> None:
        self.times += 1

    def by_name(self) -> dict[str, ClusterNode]:
        return {node.name: node for node in self.all.of(config()).get("c-its", ())}


@pytest.fixture
def api() -> Iterator[KubeApi]:
    with kube_api() as made:
        yield made


@pytest.fixture
def told(api: KubeApi, tmp_path: Path) -> Iterator[Told]:
    made = Told(tmp_path, api.url)
    yield made
    made.all.close()


def put(api: KubeApi, name: str, *, ready: str = "True", **more: Any) -> None:
    labels = {"node_id": name} | more.pop("labels", {})
    status = {"allocatable": {"cpu": "4"}, "conditions": [{"type": "Ready", "status": ready}]}
    metadata = {"labels": labels, "managedFields": more.pop("fields", [])}
    api.put(*NODES, name, status, metadata=metadata, **more)


def test_nodes_come_change_and_go(api: KubeApi, told: Told) -> None:
    put(api, "bus0")
    put(api, "bus1")
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
    put(api, "bus0", fields=fields, **cordoned)
    wait_until(lambda: told.by_name()["bus0"].is_cordoned, "the cordon")
    writers = told.by_name()["bus0"].writers
    assert writers[""] == "kubectl-cordon"
    assert writers["demandops/type"] == "kubectl-label"
    api.delete(*NODES, "bus1")
    wait_until(lambda: [*told.by_name()] == ["bus0"], "the deletion")
    assert api.reads == 1


def test_what_no_decision_sees_is_not_told(api: KubeApi, told: Told) -> None:
    put(api, "bus0")
    wait_until(told.by_name, "the list")
    before = told.times
    for ready in ("False", "Unknown", "True"):
        put(api, "bus0", ready=ready)
    put(api, "bus1")  # a watch tells all in order
    wait_until(lambda: "bus1" in told.by_name(), "the second node")
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
    told = Told(tmp_path, "http://127.0.0.1:1")
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
