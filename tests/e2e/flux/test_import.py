"""`demandops import` on a real API: the custom resources of the reference, with few rights.

Their definitions are ours: the names of the reference's, and any content.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tests.e2e.common.access import access_file, limited
from tests.e2e.common.running import CLUSTER
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import build_manifest
from tests.kit.cli import runner
from tests.kit.goals import EXPERIMENT
from tests.kit.reference import OPERATORS, Reference
from tests.kit.repo import books, init

GROUP, NAMESPACE = "ika.rwth-aachen.de", "reference"
PLURALS = [f"{kind.lower()}s" for kind in OPERATORS]
LISTER = {"apiGroups": [GROUP], "resources": PLURALS, "verbs": ["list"]}


def definition(kind: str) -> dict[str, object]:
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


def test_the_resources_of_the_reference_are_read_from_a_cluster(
    rig: Rig,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    definitions = tmp_path / "definitions.yaml"
    definitions.write_text(yaml.safe_dump_all(map(definition, OPERATORS)))
    reference = Reference()
    for path in EXPERIMENT[:6]:
        reference.send(yaml.safe_load(path.read_text()))
    files = [path for path in reference.write(tmp_path / "files") if "bookkeeping" in path.name]
    rig.kube.install_crds([definitions])
    try:
        rig.kube.apply(build_manifest("v1", "Namespace", NAMESPACE))
        for item in reference.resources.values():
            name = {"name": item["metadata"]["name"], "namespace": NAMESPACE}
            rig.kube.apply(item | {"metadata": name})
        rights = {NAMESPACE: [LISTER]}
        kubeconfig = limited(rig.kube, rig.kubeconfig, tmp_path, rights)
        access = access_file(tmp_path, CLUSTER, kubeconfig=kubeconfig)
        run, repo = runner(capsys, monkeypatch), init(tmp_path / "fleet.git")
        options = ["--state-repo", repo, "--map", tmp_path / "map.yaml"]
        options += ["--clusters", access, "--cluster", CLUSTER, "--namespace", NAMESPACE]
        for _ in ("proposes the map", "books"):
            done = run("import", *files, *options)
            assert done.code == 0, done.err
    finally:
        rig.kube.delete("Namespace", NAMESPACE)
        for plural in PLURALS:
            rig.kube.delete("CustomResourceDefinition", f"{plural}.{GROUP}")
    assert list(books(repo)["connections"]) == [
        "station00/edge",
        "vehicle02/edge",
        "vehicle03/edge",
    ]
