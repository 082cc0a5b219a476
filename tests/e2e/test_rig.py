"""The rig starts, reconciles, prunes and stops, as the other end-to-end tests need it to."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.rig.clone import Clone
from tests.e2e.rig.cluster import Rig, start_all
from tests.e2e.rig.errors import RigError
from tests.e2e.rig.kube import build_manifest, handled
from tests.e2e.rig.kwok import HOLD_ANNOTATION
from tests.e2e.rig.tools import Report

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
ACCOUNT = "domain"
PLACEHOLDER = "{apiVersion: v1, kind: ConfigMap, metadata: {name: placeholder}}"


@pytest.fixture(scope="module")
def rig(request: pytest.FixtureRequest, say: Report) -> Iterator[Rig]:
    failed = request.session.testsfailed
    cluster = Rig("smoke", nodes=["edge"], report=say)
    cluster.start()
    say(f"\nrig started: {cluster.timings}")
    try:
        yield cluster
    finally:
        start = time.monotonic()
        cluster.stop(failed=request.session.testsfailed > failed)
        say(f"\nrig stopped in {time.monotonic() - start:.2f} s")


class Domain:
    """An access domain in a small state repo, with namespace, account, source and Kustomization."""

    def __init__(self, rig: Rig, folder: Path, say: Report) -> None:
        self.rig, self.kube, self.say = rig, rig.kube, say
        self.name = f"smoke-{uuid.uuid4().hex[:8]}"
        self.clone = Clone(rig.push_url(f"{self.name}.git"), folder / self.name)
        self._at = time.monotonic()

    def create(self, files: dict[str, str]) -> None:
        # Flux refuses a sparse checkout of a missing folder.
        always = {"clusters/edge/placeholder.yaml": PLACEHOLDER, "charts/.gitkeep": ""}
        self.clone.push({**always, **files}, "start")
        self.lap("first push")
        self.kube.apply(
            build_manifest("v1", "Namespace", self.name),
            build_manifest("v1", "ServiceAccount", ACCOUNT, self.name),
            build_manifest(
                "rbac.authorization.k8s.io/v1",
                "Role",
                ACCOUNT,
                self.name,
                rules=[{"apiGroups": ["*"], "resources": ["*"], "verbs": ["*"]}],
            ),
            build_manifest(
                "rbac.authorization.k8s.io/v1",
                "RoleBinding",
                ACCOUNT,
                self.name,
                roleRef={
                    "apiGroup": "rbac.authorization.k8s.io",
                    "kind": "Role",
                    "name": ACCOUNT,
                },
                subjects=[{"kind": "ServiceAccount", "name": ACCOUNT, "namespace": self.name}],
            ),
            build_manifest(
                "source.toolkit.fluxcd.io/v1",
                "GitRepository",
                "state",
                self.name,
                spec={
                    "url": self.rig.git_url(f"{self.name}.git"),
                    "interval": "1h",
                    "ref": {"branch": "main"},
                    "sparseCheckout": ["clusters/edge", "charts"],
                },
            ),
            build_manifest(
                "kustomize.toolkit.fluxcd.io/v1",
                "Kustomization",
                "edge",
                self.name,
                spec={
                    "sourceRef": {"kind": "GitRepository", "name": "state"},
                    "path": "clusters/edge",
                    "interval": "1h",
                    "retryInterval": "1s",
                    "prune": True,
                    "serviceAccountName": ACCOUNT,
                    "targetNamespace": self.name,
                },
            ),
        )
        self.kube.wait_ready("GitRepository", "state", self.name)
        self.lap("GitRepository ready")
        self.kube.wait_ready("Kustomization", "edge", self.name)
        self.lap("Kustomization ready")

    def push(self, files: dict[str, str | None]) -> None:
        """Push files, trigger the source, and wait until the Kustomization has applied them."""
        commit = self.clone.push(files)
        token = self.kube.reconcile("GitRepository", "state", self.name)

        def seen() -> bool:
            source = self.kube.get("GitRepository", "state", self.name) or {}
            return handled(source, token)

        def applied() -> bool:
            kustomization = self.kube.get("Kustomization", "edge", self.name) or {}
            revision = kustomization.get("status", {}).get("lastAppliedRevision", "")
            return bool(revision.endswith(commit))

        self.kube.wait("the source to fetch", seen)
        self.kube.wait(f"{commit} to be applied", applied)
        self.lap("pushed change applied")

    def pods(self) -> list[dict[str, Any]]:
        return self.kube.find("Pod", self.name)

    def lap(self, stage: str) -> None:
        now = time.monotonic()
        self.say(f"  {stage}: {now - self._at:.2f} s")
        self._at = now

    def remove(self) -> None:
        for kind, name in (("Kustomization", "edge"), ("GitRepository", "state")):
            self.kube.delete(kind, name, self.name)
            self.kube.wait_gone(kind, name, self.name)
        self.kube.delete("Namespace", self.name)


@pytest.fixture
def domain(rig: Rig, tmp_path: Path, say: Report) -> Iterator[Domain]:
    made = Domain(rig, tmp_path, say)
    yield made
    made.remove()


def config(value: str) -> str:
    return json.dumps(build_manifest("v1", "ConfigMap", "greeting", data={"value": value}))


def deployment(node_id: str, name: str = "sleeper", **annotations: str) -> str:
    labels = {"app": name}
    container = {"name": "main", "image": "example.invalid/sleeper:1"}
    template = {
        "metadata": {"labels": labels, "annotations": annotations},
        "spec": {"nodeSelector": {"node_id": node_id}, "containers": [container]},
    }
    spec = {"replicas": 1, "selector": {"matchLabels": labels}, "template": template}
    return json.dumps(build_manifest("apps/v1", "Deployment", name, spec=spec))


def running_on(pods: list[dict[str, Any]]) -> set[str]:
    """Return the names of the nodes on which ready pods run."""
    ready = [
        pod
        for pod in pods
        for condition in pod.get("status", {}).get("conditions", [])
        if condition["type"] == "Ready" and condition["status"] == "True"
    ]
    return {pod["spec"]["nodeName"] for pod in ready}


def test_a_push_becomes_a_pod_changes_and_goes(domain: Domain) -> None:
    files = {
        "clusters/edge/config.yaml": config("one"),
        "clusters/edge/deployment.yaml": deployment("edge"),
    }
    domain.create(files)
    domain.kube.wait("the pod to be ready", lambda: running_on(domain.pods()) == {"edge"})
    domain.lap("pod ready")

    domain.push({"clusters/edge/config.yaml": config("two")})
    found = domain.kube.get("ConfigMap", "greeting", domain.name)
    assert found is not None
    assert found["data"] == {"value": "two"}

    domain.push({"clusters/edge/config.yaml": None, "clusters/edge/deployment.yaml": None})
    assert domain.kube.get("ConfigMap", "greeting", domain.name) is None
    domain.kube.wait("the pod to go", lambda: domain.pods() == [])
    domain.lap("pod gone")
    assert domain.kube.get("ConfigMap", "placeholder", domain.name) is not None


def test_a_pod_waits_for_its_node_and_a_held_one_forever(rig: Rig, domain: Domain) -> None:
    late = f"vehicle_{uuid.uuid4().hex[:6]}"
    held = deployment("edge", "held", **{HOLD_ANNOTATION: "yes"})
    files = {"clusters/edge/late.yaml": deployment(late), "clusters/edge/held.yaml": held}
    domain.create(files)
    domain.kube.wait("the pods", lambda: len(domain.pods()) == 2)
    assert running_on(domain.pods()) == set()
    (name,) = rig.add_nodes([late])
    domain.lap("node added")
    domain.kube.wait("the pod to be ready", lambda: running_on(domain.pods()) == {name})
    domain.lap("pod ready")


def chart() -> dict[str, str]:
    return {
        "charts/sleeper/Chart.yaml": "apiVersion: v2\nname: sleeper\nversion: 0.1.0\n",
        "charts/sleeper/values.yaml": "node_id: nowhere\n",
        "charts/sleeper/templates/deployment.yaml": textwrap.dedent("""\
            apiVersion: apps/v1
            kind: Deployment
            metadata:
              name: {{ .Release.Name }}
            spec:
              selector:
                matchLabels: {app: {{ .Release.Name | quote }}}
              template:
                metadata:
                  labels: {app: {{ .Release.Name | quote }}}
                spec:
                  nodeSelector: {node_id: {{ .Values.node_id | quote }}}
                  containers:
                    - {name: main, image: "example.invalid/sleeper:1"}
            """),
    }


def release() -> dict[str, str]:
    chart_spec = {
        "chart": "charts/sleeper",
        "interval": "1h",
        "sourceRef": {"kind": "GitRepository", "name": "state"},
    }
    release_spec = {
        "chartRef": {"kind": "HelmChart", "name": "sleeper"},
        "interval": "1h",
        "serviceAccountName": ACCOUNT,
        "install": {"strategy": {"name": "RetryOnFailure", "retryInterval": "1s"}},
        "driftDetection": {"mode": "enabled"},
        "values": {"node_id": "edge"},
    }
    return {
        "clusters/edge/chart.yaml": json.dumps(
            build_manifest("source.toolkit.fluxcd.io/v1", "HelmChart", "sleeper", spec=chart_spec)
        ),
        "clusters/edge/release.yaml": json.dumps(
            build_manifest("helm.toolkit.fluxcd.io/v2", "HelmRelease", "nap", spec=release_spec)
        ),
    }


def test_a_release_runs_as_its_account_and_is_uninstalled(rig: Rig, domain: Domain) -> None:
    domain.create(chart() | release())
    domain.kube.wait_ready("HelmRelease", "nap", domain.name)
    domain.lap("HelmRelease ready")
    assert running_on(domain.pods()) == {"edge"}
    assert "nap" in rig.helm("list", "--namespace", domain.name, "--short").split()

    domain.push({"clusters/edge/release.yaml": None})
    domain.kube.wait_gone("HelmRelease", "nap", domain.name)
    domain.lap("HelmRelease gone")
    assert rig.helm("list", "--namespace", domain.name, "--short").split() == []
    domain.kube.wait("the pod to go", lambda: domain.pods() == [])
    domain.lap("pod gone")
    assert domain.kube.get("ServiceAccount", ACCOUNT, domain.name) is not None


def test_parts_can_be_killed_paused_and_started_again(rig: Rig, domain: Domain) -> None:
    if rig.existing:
        pytest.skip("the tests may not kill parts of an existing cluster")
    domain.create({"clusters/edge/config.yaml": config("one")})
    for part in ("git", "source-controller", "kustomize-controller", "kube-apiserver", "etcd"):
        before = rig.pids()[part]
        rig.kill(part)
        assert part not in rig.pids()
        rig.start_component(part)
        assert rig.pids()[part] != before
        domain.lap(f"{part} killed and started")
        domain.push({"clusters/edge/config.yaml": config(part)})

    rig.pause("git")
    token = domain.kube.reconcile("GitRepository", "state", domain.name)
    time.sleep(1)
    assert not handled(domain.kube.get("GitRepository", "state", domain.name) or {}, token)
    rig.resume("git")
    domain.push({"clusters/edge/config.yaml": config("after the pause")})


def test_a_part_that_dies_is_named_with_its_log(rig: Rig) -> None:
    if rig.existing:
        pytest.skip("the tests may not kill parts of an existing cluster")
    os.kill(rig.pids()["kwok"], signal.SIGKILL)
    with pytest.raises(RigError) as caught:
        rig.kube.wait("an event that never happens", lambda: None)
    assert str(caught.value).startswith("kwok: ended with -9 after ")
    assert f"{rig.log('kwok')} ends with:\n" in str(caught.value)
    rig.restart("kwok")
    rig.check()


def test_two_rigs_read_one_git_server_that_wants_a_password(say: Report, tmp_path: Path) -> None:
    first = Rig("first", nodes=["edge"], credentials=("ops", "s3cret"), report=say)
    if first.existing:
        pytest.skip("the test starts two clusters only if no cluster is given")
    first.start()
    second = Rig("second", nodes=["vehicle00"], git_of=first, report=say)
    try:
        second.start()
        say(f"  second cluster beside the first: {second.timings}")
        Clone(first.push_url("state.git"), tmp_path / "clone").push({"a.yaml": "{}"})
        spec = {
            "url": second.git_url("state.git"),
            "interval": "1h",
            "ref": {"branch": "main"},
            "secretRef": {"name": "git"},
        }
        login = {"username": "ops", "password": "s3cret"}
        for cluster in (first, second):
            cluster.kube.apply(build_manifest("v1", "Secret", "git", "default", stringData=login))
            source = build_manifest("source.toolkit.fluxcd.io/v1", "GitRepository", "s", "default")
            cluster.kube.apply({**source, "spec": spec})
            cluster.kube.wait_ready("GitRepository", "s", "default")
        with pytest.raises(AssertionError, match="could not read Username"):
            Clone(first.git_url("state.git"), tmp_path / "other").push({"b.yaml": "{}"})
        nodes = [n["metadata"]["name"] for c in (first, second) for n in c.kube.find("Node")]
        assert nodes == ["edge", "vehicle00"]
    finally:
        second.stop()
        first.stop()


def test_nothing_outlives_a_stop(say: Report) -> None:
    rig = Rig("brief", report=say)
    if rig.existing:
        pytest.skip("the test starts nothing if a cluster is given")
    start_all(rig)
    pids, folder = rig.pids(), rig.kubeconfig.parent
    assert sorted(pids) == sorted(rig.components())
    rig.stop()
    rig.stop()
    assert [name for name, pid in pids.items() if Path(f"/proc/{pid}").exists()] == []
    assert not folder.exists()


def test_nothing_outlives_a_killed_test_run(tmp_path: Path) -> None:
    if Rig("probe").existing:
        pytest.skip("the test starts nothing if a cluster is given")
    program = "import json, time; from tests.e2e.rig.cluster import Rig; r = Rig('orphan')\n"
    program += "r.start(); print(json.dumps(r.pids()), flush=True); time.sleep(300)"
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    run = subprocess.Popen(
        [sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    try:
        pids = json.loads(run.stdout.readline())
    finally:
        run.kill()
        run.wait()
        run.stdout.close()
    assert len(pids) > 8
    deadline = time.monotonic() + 60
    while alive := [name for name, pid in pids.items() if Path(f"/proc/{pid}").exists()]:
        assert time.monotonic() < deadline, alive
        time.sleep(0.1)
