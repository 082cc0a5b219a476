"""A thousand nodes of a real API server become one commit, and what no decision sees none."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.nodes import ClusterNodes
from demandops.decide.discovery import ClusterNode
from demandops.serve import node_discovery
from kubernetes.client import CoreV1Api

from tests.e2e.common.access import limited
from tests.e2e.common.expected import CLUSTER
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import build_manifest
from tests.kit import plain_yaml
from tests.kit import rig as kit
from tests.kit.clock import Clock
from tests.kit.memory import NOW
from tests.kit.repo import Person, assert_sound, commits, git, init, read

pytestmark = pytest.mark.only("flux", "the nodes do not depend on the controller")

MANY = 1_000
FILE = f"inventory/discovered/{CLUSTER}.yaml"
CLUSTERS = f"""\
apiVersion: demandops/v1
kind: Clusters
clusters:
  - name: {CLUSTER}
    nodes: from-cluster
    discovery: {{selector: {{fleet: public}}}}
"""
ROLE = Path(__file__).parents[2] / "deploy" / "nodes-role.yaml"
_RBAC = "rbac.authorization.k8s.io"


class Fleet:
    """The buses of a cluster, which no kubelet and no controller changes."""

    def __init__(self, rig: Rig) -> None:
        self._api: Any = CoreV1Api(rig.kube.api)

    def add(self, number: int) -> None:
        labels = {"node_id": f"bus{number:04}", "fleet": "public", "demandops/type": "vehicle"}
        allocatable = {"cpu": "4", "memory": "16384256Ki", "pods": "110"}
        status = {"allocatable": allocatable, "capacity": allocatable}
        metadata = {"name": f"bus{number:04}.fleet.example", "labels": labels}
        self._api.create_node({"metadata": metadata, "status": status})

    def cordon(self, number: int) -> None:
        body = {"spec": {"unschedulable": True}}
        name = f"bus{number:04}.fleet.example"
        self._api.patch_node(name, body, field_manager="kubectl-cordon")

    def flap(self, number: int, *, ready: bool) -> None:
        condition = {"type": "Ready", "status": str(ready), "reason": "KubeletNotReady"}
        images = [{"names": [f"registry.example/image:{ready}"], "sizeBytes": 1}]
        body = {"status": {"conditions": [condition], "images": images}}
        self._api.patch_node_status(f"bus{number:04}.fleet.example", body)

    def remove(self, number: int) -> None:
        self._api.delete_node(f"bus{number:04}.fleet.example")

    def clear(self) -> None:
        self._api.delete_collection_node(label_selector="fleet=public")


@pytest.fixture
def fleet(rig: Rig) -> Iterator[Fleet]:
    made = Fleet(rig)
    yield made
    made.clear()


@pytest.fixture
def access(rig: Rig, tmp_path: Path) -> ClusterAccess:
    """What docs/inventory.md says that a generator needs."""
    role = yaml.safe_load(ROLE.read_text())
    reference = {"apiGroup": _RBAC, "kind": "ClusterRole", "name": role["metadata"]["name"]}
    binding = build_manifest(
        f"{_RBAC}/v1",
        "ClusterRoleBinding",
        "demandops-nodes",
        roleRef=reference,
        subjects=[{"kind": "ServiceAccount", "name": "generator", "namespace": "default"}],
    )
    kubeconfig = limited(rig.kube, rig.kubeconfig, tmp_path, {"default": []})
    rig.kube.apply(role, binding)
    return ClusterAccess(kubeconfig=kubeconfig)


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    path = init(tmp_path / "state.git")
    Person(path, tmp_path / "petra").change({"inventory/clusters.yaml": CLUSTERS})
    return path


class Looking:
    """A generator that takes over the nodes; only the test lets time pass for it."""

    def __init__(self, bare: Path, access: ClusterAccess) -> None:
        self._bare, self.clock = bare, Clock(NOW)
        self._running = kit.running(bare, runtime=self.clock)
        self.generator = self._running.__enter__()
        self._nodes = ClusterNodes({CLUSTER: access}, self.generator.nodes_changed)
        self.generator.take_over_nodes(self._nodes.of)

    def knows(self, true: Callable[[list[ClusterNode]], bool]) -> None:
        """Wait until the watch has told of a change, and so of all before it."""
        config = self.generator.snapshot.state.config
        kit.wait_until(lambda: true(self._nodes.of(config)[CLUSTER]), "the watch")

    def until(self, seen: Callable[[dict[str, Any]], object]) -> None:
        """Let minutes pass until the file is as it must be."""

        def look() -> object:
            self.clock.pass_(node_discovery._PAUSE_S)
            text = read(self._bare, FILE)
            return text and seen({node["id"]: node for node in plain_yaml.load(text)["nodes"]})

        kit.wait_until(look, "the file of the nodes")

    def close(self) -> None:
        self._nodes.close()
        self._running.__exit__(None, None, None)


def test_a_thousand_nodes_and_what_a_decision_sees_of_them(
    fleet: Fleet, bare: Path, access: ClusterAccess, request: pytest.FixtureRequest
) -> None:
    for number in range(MANY):
        fleet.add(number)
    looking = Looking(bare, access)
    request.addfinalizer(looking.close)
    looking.until(lambda nodes: nodes)
    found = plain_yaml.load(read(bare, FILE))["nodes"]
    assert len(found) == MANY
    capacity = {"cpu": "4", "memory": "16384256Ki"}
    assert found[7] == {"id": "bus0007", "type": "vehicle", "capacity": capacity}

    for ready in (False, True):
        for number in range(0, MANY, 4):
            fleet.flap(number, ready=ready)
        looking.clock.pass_(node_discovery._PAUSE_S)
    fleet.cordon(500)  # a watch tells all in order
    looking.until(lambda nodes: "drained" in nodes["bus0500"])

    for number in range(10):
        fleet.cordon(number)
    looking.knows(lambda nodes: sum(node.is_cordoned for node in nodes) == 11)
    looking.until(lambda nodes: "drained" in nodes["bus0009"])
    fleet.remove(20)
    looking.until(lambda nodes: "goneSince" in nodes["bus0020"])

    made = [commit for commit in commits(bare) if commit.one("Operation") == "discover"]
    assert [commit.summary.partition(": ")[2] for commit in made] == [
        f"{MANY} came",
        "1 changed",
        "10 changed",
        "1 gone",
    ]
    message = git(bare, "log", "-1", "--format=%B", made[2].id)
    assert "~ bus0009: cordoned by 'kubectl-cordon'" in message
    assert looking.generator.snapshot.state.config.nodes["bus0009"].drained
    assert_sound(bare)
