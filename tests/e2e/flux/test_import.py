"""The move from the reference, with a real API: `demandops import`, and all of docs/migration.md.

The tests' CRDs have the names of the reference's custom resources and allow any content.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.e2e.common.access import access_file, limited
from tests.e2e.common.expected import CLUSTER, NAMESPACE, WITHOUT_DEMANDS, after
from tests.e2e.common.staterepo import environment
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import Manifest, build_manifest
from tests.kit.cli import runner
from tests.kit.goals import EXPERIMENT
from tests.kit.reference import OPERATORS, Reference
from tests.kit.repo import books, init

from .view import Domain

GROUP, ELSEWHERE = "ika.rwth-aachen.de", "reference"
PLURALS = [f"{kind.lower()}s" for kind in OPERATORS]
LISTER = {"apiGroups": [GROUP], "resources": PLURALS, "verbs": ["list"]}
STEPS = 6
PAGE = (Path(__file__).parents[3] / "docs" / "migration.md").read_text()
RBAC = "rbac.authorization.k8s.io/v1"


@pytest.fixture
def reference(rig: Rig, tmp_path: Path) -> Iterator[Reference]:
    """The reference after the first steps of the experiment; the cluster has its CRDs."""
    made = Reference()
    for path in EXPERIMENT[:STEPS]:
        made.send(yaml.safe_load(path.read_text()))
    definitions = tmp_path / "definitions.yaml"
    definitions.write_text(yaml.safe_dump_all(map(definition, OPERATORS)))
    rig.kube.install_crds([definitions])
    yield made
    for plural in PLURALS:
        rig.kube.delete("CustomResourceDefinition", f"{plural}.{GROUP}")
        rig.kube.wait_gone("CustomResourceDefinition", f"{plural}.{GROUP}")


def definition(kind: str) -> Manifest:
    names = {"plural": f"{kind.lower()}s", "singular": kind.lower(), "kind": kind}
    schema = {"type": "object", "x-kubernetes-preserve-unknown-fields": True}
    version = {"name": "v1", "served": True, "storage": True}
    return {
        "apiVersion": "apiextensions.k8s.io/v1",
        "kind": "CustomResourceDefinition",
        "metadata": {"name": f"{names['plural']}.{GROUP}"},
        "spec": {
            "group": GROUP,
            "scope": "Namespaced",
            "names": names,
            "versions": [version | {"schema": {"openAPIV3Schema": schema}}],
        },
    }


def apply_resources(rig: Rig, reference: Reference, namespace: str) -> None:
    for item in reference.resources.values():
        name = {"name": item["metadata"]["name"], "namespace": namespace}
        rig.kube.apply(item | {"metadata": name})


def test_the_resources_of_the_reference_are_read_from_a_cluster(
    rig: Rig,
    reference: Reference,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    files = [path for path in reference.write(tmp_path / "files") if "bookkeeping" in path.name]
    rig.kube.apply(build_manifest("v1", "Namespace", ELSEWHERE))
    try:
        apply_resources(rig, reference, ELSEWHERE)
        kubeconfig = limited(rig.kube, rig.kubeconfig, tmp_path, {ELSEWHERE: [LISTER]})
        access = access_file(tmp_path, CLUSTER, kubeconfig=kubeconfig)
        run, repo = runner(capsys, monkeypatch), init(tmp_path / "fleet.git")
        options = ["--state-repo", repo, "--map", tmp_path / "map.yaml"]
        options += ["--clusters", access, "--cluster", CLUSTER, "--namespace", ELSEWHERE]
        for _ in ("proposes the map", "books"):
            done = run("import", *files, *options)
            assert done.code == 0, done.err
    finally:
        rig.kube.delete("Namespace", ELSEWHERE)
    assert list(books(repo)["connections"]) == [
        "station00/edge",
        "vehicle02/edge",
        "vehicle03/edge",
    ]


class Shell:
    """Runs the commands of docs/migration.md in a folder that the rig's Git server serves."""

    def __init__(self, rig: Rig, folder: Path, volumes: Path) -> None:
        self.folder = rig.repository("any.git").parent
        program = folder / "bin" / "demandops"
        program.parent.mkdir()
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m demandops.cli.main "$@"\n')
        program.chmod(0o755)
        self._environment = environment(folder) | {
            "KUBECONFIG": str(rig.kubeconfig),
            "PATH": f"{program.parent}:{os.environ['PATH']}",
        }
        self._here = {
            "https://git.example/fleet.git": rig.git_url("fleet.git"),
            "/bookkeeping_data/": f"{volumes}/",  # a fake pod has no files of its own
        }

    def commands(self, title: str) -> list[str]:
        """Return the commands in a section of the page, except those that run for ever."""
        (section,) = re.findall(rf"^## (?:\d\. )?{title}$(.*?)(?=^## |\Z)", PAGE, re.M | re.S)
        found = re.findall(r"^    (\S.*)$", section, re.MULTILINE)
        return [one for one in found if not one.startswith(("ros2 ", "demandops serve "))]

    def run(self, *commands: str) -> str:
        """Run commands in turn; return what the last one prints."""
        printed = ""
        for command in commands:
            text = command
            for there, here in self._here.items():
                text = text.replace(there, here)
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", text],
                cwd=self.folder,
                env=self._environment,
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, f"{command}\n{done.stderr}"
            printed = done.stdout
        return printed


def left_by_the_reference() -> Iterator[Manifest]:
    """Yield the objects of an installation of the reference, without CRDs and custom resources."""
    for operator in ("mqtt", "object-detection", "object-fusion"):
        name = f"kopf-operator-{operator}"
        metadata = {"labels": {"app": name}}
        containers = [{"name": name, "image": "kopf"}]
        yield build_manifest(
            "apps/v1",
            "Deployment",
            name,
            "default",
            spec={
                "selector": {"matchLabels": {"app": name}},
                "template": {"metadata": metadata, "spec": {"containers": containers}},
            },
        )
    role = {"apiGroup": "rbac.authorization.k8s.io", "name": "am"}
    size = {"storage": "10Mi"}
    of_volumes = {"storageClassName": "standard", "accessModes": ["ReadWriteOnce"]}
    volume = {"capacity": size, "hostPath": {"path": "/nowhere"}}
    claim = {"volumeName": "am", "resources": {"requests": size}}
    for version, kind, namespace, fields in (
        ("v1", "ConfigMap", "default", {}),
        ("v1", "ServiceAccount", "default", {}),
        (RBAC, "Role", "default", {}),
        (RBAC, "RoleBinding", "default", {"roleRef": role | {"kind": "Role"}}),
        (RBAC, "ClusterRole", "", {}),
        (RBAC, "ClusterRoleBinding", "", {"roleRef": role | {"kind": "ClusterRole"}}),
        ("v1", "PersistentVolume", "", {"spec": of_volumes | volume}),
        ("v1", "PersistentVolumeClaim", "default", {"spec": of_volumes | claim}),
    ):
        made = build_manifest(version, kind, "am", namespace, **fields)
        made["metadata"]["labels"] = {"tag": "am"}
        yield made


def test_a_fleet_moves_over_and_back_by_the_commands_of_the_page(
    rig: Rig, reference: Reference, tmp_path: Path
) -> None:
    if rig.existing:
        pytest.skip("the namespace default of an existing cluster is not ours")
    shell = Shell(rig, tmp_path, tmp_path / "volumes")
    reference.write(tmp_path / "volumes")
    left = list(left_by_the_reference())
    rig.kube.apply(*left)
    apply_resources(rig, reference, "default")
    for item in left[:3]:
        name = item["metadata"]["name"]
        rig.kube.wait(f"a pod of {name}", lambda name=name: running(rig, name))

    shell.run(*shell.commands("Side by side"), *shell.commands("Take over what is held"))
    assert [*books(shell.folder / "fleet.git")["connections"]] == [
        "station00/edge",
        "vehicle02/edge",
        "vehicle03/edge",
    ]

    *cut, shown = shell.commands("Cut over")
    shell.run(*cut)
    domain = Domain(rig.kube, NAMESPACE, NAMESPACE)
    domain.wait_lines(after(STEPS))
    assert "station00/edge" in shell.run(shown)
    assert rig.kube.find("MqttConnection", version=f"{GROUP}/v1") == []

    shell.run(*shell.commands("Remove what is left"))
    for item in (*left, *map(definition, OPERATORS)):
        metadata = item["metadata"]
        rig.kube.wait_gone(item["kind"], metadata["name"], metadata.get("namespace", ""))

    rollback, look, remove = shell.commands("Going back")
    shell.run(rollback)
    domain.wake()
    domain.wait_lines(WITHOUT_DEMANDS)
    assert shell.run(look) == ""
    shell.run(remove)
    assert rig.kube.get("Namespace", NAMESPACE) is None


def running(rig: Rig, app: str) -> bool:
    pods = rig.kube.find("Pod", "default", f"app={app}")
    return [pod["status"].get("phase") for pod in pods] == ["Running"]
