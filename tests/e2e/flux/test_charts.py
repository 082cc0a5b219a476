"""Charts and golden manifests before the judge: the real helm, and the API server's dry run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.e2e.common.golden import golden
from tests.e2e.common.running import NAMESPACE
from tests.e2e.common.steps import (
    test_the_server_does_look,
    test_the_server_takes_every_golden_manifest,
)
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import Manifest

__all__ = ["test_the_server_does_look", "test_the_server_takes_every_golden_manifest"]
ROOT = Path(__file__).resolve().parents[3]
FOLDERS = (
    ROOT / "appdefs" / "object-detection-fusion" / "charts",
    ROOT / "examples" / "lane-detection" / "appdefs" / "lane-detection" / "charts",
)
CHARTS = {path.name: path for folder in FOLDERS for path in folder.iterdir()}


# Every corner that a person may set and no golden case does.
_COMMON: dict[str, dict[str, Any]] = {
    "as it comes": {},
    "all set": {
        "replicas": 2,
        "image": {"digest": "sha256:" + 64 * "0", "pullPolicy": "Always"},
        "imagePullSecrets": [{"name": "registry"}],
        "nodeSelector": {"node_id": "edge", "example.invalid/gpu": "yes"},
        "tolerations": [{"key": "busy", "operator": "Exists", "effect": "NoSchedule"}],
        "hostNetwork": True,
        "ros": {
            "domainId": 42,
            "rmwImplementation": "rmw_zenoh_cpp",
            "env": [{"name": "HOME", "value": '$(touch /tmp/x); "#: {'}],
        },
        "workspaceSetup": ["install/setup.bash", "/opt/other/setup.bash"],
        "podLabels": {"team": "perception"},
        "podAnnotations": {"note": 'a: "b" # c'},
    },
    "without what can be without": {
        "replicas": 0,
        "workspaceSetup": [],
        "probes": {"startup": None, "readiness": None, "liveness": None},
        "serviceAccount": {"create": False, "name": "somebody"},
    },
}
_INPUTS = {"egoData": ["/b", "/a", "/b"], "objectList": ["/list"]}
VALUES = {
    "object-detection": _COMMON,
    "object-fusion": {**_COMMON, "with inputs": {"inputs": _INPUTS}},
    "ros-launch": {
        "as it comes": {},
        "all set": {
            "replicas": 0,
            "image": {"repository": "registry.example/x", "digest": "sha256:" + 64 * "0"},
            "node": {
                "selector": {"node_id": "edge"},
                "tolerations": [{"key": "busy", "operator": "Exists", "effect": "NoSchedule"}],
                "image_pull_secrets": ["registry"],
                "host_network": True,
                "ros": {"domain_id": 42, "rmw": "rmw_zenoh_cpp"},
            },
            "launch": {"arguments": {"topic": '$(touch /tmp/x); "#: {'}},
            "workspaceSetup": ["install/setup.bash"],
        },
    },
}
CASES = [pytest.param(c, v, id=f"{c} {n}") for c, cases in VALUES.items() for n, v in cases.items()]


@pytest.fixture(scope="module")
def namespace(rig: Rig) -> str:
    rig.kube.apply({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NAMESPACE}})
    return NAMESPACE


@pytest.mark.parametrize(("chart", "values"), CASES)
def test_a_chart_passes_lint_and_what_it_gives_the_server(
    rig: Rig, namespace: str, tmp_path: Path, chart: str, values: dict[str, Any]
) -> None:
    given = tmp_path / "values.json"
    given.write_text(json.dumps(values))
    rig.helm("lint", "--strict", "--quiet", f"--values={given}", str(CHARTS[chart]))
    made = templated(rig, chart, given, "some-release")
    assert {"Deployment"} <= {manifest["kind"] for manifest in made}
    rig.kube.apply(*made, dry_run=True)


def test_every_golden_release_gives_what_the_server_takes(
    rig: Rig, namespace: str, tmp_path: Path
) -> None:
    seen = 0
    for number, manifest in enumerate(golden("flux")):
        if manifest["kind"] != "HelmRelease":
            continue
        given = tmp_path / f"{number}.json"
        given.write_text(json.dumps(manifest["spec"]["values"]))
        release = manifest["metadata"]["name"]
        chart = "object-fusion" if release.startswith("of-") else "object-detection"
        made = templated(rig, chart, given, release)
        rig.kube.apply(*made, dry_run=True)
        seen += 1
    assert seen > len(VALUES)


def templated(rig: Rig, chart: str, values: Path, release: str) -> list[Manifest]:
    """What helm makes of a chart, with the namespace that it would install into."""
    text = rig.helm(
        "template", release, str(CHARTS[chart]), f"--namespace={NAMESPACE}", f"--values={values}"
    )
    made = [manifest for manifest in yaml.safe_load_all(text) if manifest]
    for manifest in made:
        manifest["metadata"].setdefault("namespace", NAMESPACE)
    return made
