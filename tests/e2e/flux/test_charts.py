"""The real helm and the API server's dry run accept the charts and all golden manifests."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.repo.pull_request.helm import HELM_BIN

from tests.e2e.common.expected import NAMESPACE
from tests.e2e.common.golden import golden
from tests.e2e.common.steps import (
    test_the_dry_run_refuses_an_unknown_field,
    test_the_server_takes_every_golden_manifest,
)
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import Manifest
from tests.kit.cli import Run
from tests.kit.golden import CASES as CASES_OF_GOLDEN
from tests.kit.golden import whole

__all__ = [
    "test_the_dry_run_refuses_an_unknown_field",
    "test_the_server_takes_every_golden_manifest",
]
ROOT = Path(__file__).resolve().parents[3]
APPDEFS = (ROOT / "appdefs", ROOT / "examples" / "lane-detection" / "appdefs")
DETECTION = "appdefs/object-detection-fusion/charts/object-detection"
CHARTS = {
    "object-detection": "object-detection-fusion/charts/object-detection",
    "object-fusion": "object-detection-fusion/charts/object-fusion",
    "ros-launch": "lane-detection/charts/ros-launch",
}


# Values that a person may set, but that no golden case has.
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
        "fullnameOverride": "other-name",
        "priorityClassName": "system-node-critical",
        "runtimeClassName": "nvidia",
        "commonLabels": {"team": "perception"},
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
            "nodeSelector": {"node_id": "edge"},
            "tolerations": [{"key": "busy", "operator": "Exists", "effect": "NoSchedule"}],
            "imagePullSecrets": [{"name": "registry"}],
            "hostNetwork": True,
            "ros": {"domainId": 42, "rmwImplementation": "rmw_zenoh_cpp"},
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


@pytest.fixture(scope="module")
def charts(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the charts' folders by name, in a copy of `appdefs/` that helm may write to."""
    top = tmp_path_factory.mktemp("appdefs")
    for folder in reversed(APPDEFS):
        shutil.copytree(folder, top, dirs_exist_ok=True)
    found = {name: top / folder for name, folder in CHARTS.items()}
    for chart in found.values():
        rig.helm("dependency", "update", "--skip-refresh", str(chart))
    return found


@pytest.mark.parametrize(("chart", "values"), CASES)
def test_a_chart_passes_lint_and_what_it_gives_the_server(
    rig: Rig,
    namespace: str,
    charts: dict[str, Path],
    tmp_path: Path,
    chart: str,
    values: dict[str, Any],
) -> None:
    given = tmp_path / "values.json"
    given.write_text(json.dumps(values))
    rig.helm("lint", "--strict", "--quiet", f"--values={given}", str(charts[chart]))
    made = templated(rig, charts[chart], given, "some-release")
    assert {"Deployment"} <= {manifest["kind"] for manifest in made}
    rig.kube.apply(*made, dry_run=True)


def test_every_golden_release_gives_what_the_server_takes(
    rig: Rig, namespace: str, charts: dict[str, Path], tmp_path: Path
) -> None:
    seen = 0
    for number, manifest in enumerate(golden("flux")):
        if manifest["kind"] != "HelmRelease":
            continue
        given = tmp_path / f"{number}.json"
        given.write_text(json.dumps(manifest["spec"]["values"]))
        release = manifest["metadata"]["name"]
        chart = "object-fusion" if release.startswith("of-") else "object-detection"
        made = templated(rig, charts[chart], given, release)
        rig.kube.apply(*made, dry_run=True)
        seen += 1
    assert seen > len(VALUES)


def templated(rig: Rig, chart: Path, values: Path, release: str) -> list[Manifest]:
    """Return the manifests that helm renders for a chart.

    `helm template` may leave out the namespace. An install would add it, so this function does too.
    """
    text = rig.helm(
        "template", release, str(chart), f"--namespace={NAMESPACE}", f"--values={values}"
    )
    made = [manifest for manifest in yaml.safe_load_all(text) if manifest]
    for manifest in made:
        manifest["metadata"].setdefault("namespace", NAMESPACE)
    return made


@pytest.mark.parametrize("case", CASES_OF_GOLDEN)
def test_kustomize_builds_the_folder_of_a_domain(case: str, tmp_path: Path) -> None:
    """`kubectl kustomize` builds exactly the objects that the folder contains.

    The folder itself has no kustomization.yaml, because each new release would change that file.
    """
    files = {
        path: text
        for step in whole(case).values()
        for path, text in step.items()
        if path.startswith("clusters/c-its/perception/")
    }
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    folder = tmp_path / "clusters" / "c-its" / "perception"
    listed = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*.yaml"))]
    (folder / "kustomization.yaml").write_text(json.dumps({"resources": listed}))
    command = ["kubectl", "kustomize", str(folder)]
    built = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    wanted = [one for text in files.values() for one in yaml.safe_load_all(text)]
    assert len(wanted) >= len(files)
    texts = [
        sorted(json.dumps(one, sort_keys=True) for one in these)
        for these in (yaml.safe_load_all(built), wanted)
    ]
    assert texts[0] == texts[1]


class TestCheck:
    """`demandops check` with the real helm."""

    @pytest.fixture
    def checked(
        self, rig: Rig, checkout: Path, demandops: Run, monkeypatch: pytest.MonkeyPatch
    ) -> Callable[..., tuple[int, list[str], str]]:
        """Return a function that changes files and runs `demandops check`.

        The function returns the exit code, the lines of errors, and the output.
        """
        monkeypatch.setenv(HELM_BIN, str(rig.helm_program()))

        def check(files: Mapping[str, tuple[str, str]]) -> tuple[int, list[str], str]:
            for path, (old, new) in files.items():
                text = (checkout / path).read_text()
                assert old in text
                (checkout / path).write_text(text.replace(old, new, 1))
            ran = demandops("check", checkout, "--require-helm")
            errors = [line for line in ran.err.splitlines() if "is still 0.1.0" not in line]
            return ran.code, errors, ran.out

        return check

    def test_what_init_laid_down_is_rendered(self, checked: Any) -> None:
        code, errors, out = checked({})
        assert (code, errors) == (0, [])
        assert out.splitlines()[1:] == [
            "charts rendered by helm: object-detection, object-fusion (0 releases, 2 examples)"
        ]

    def test_a_new_application_is_rendered(
        self, checked: Any, checkout: Path, demandops: Run
    ) -> None:
        new = ["new", "application", "tracking", "--input", "camera=sensor_msgs/msg/Image"]
        new += ["--image", "registry.example/tracking:1.0.0", "-C", str(checkout)]
        services = ["--service", "detector=a/d.launch.py", "--service", "tracker=a/t.launch.py"]
        assert demandops(*new, *services).code == 0
        code, errors, out = checked({})
        assert (code, errors) == (0, [])
        assert out.splitlines()[1] == (
            "charts rendered by helm: object-detection, object-fusion, tracking "
            "(0 releases, 4 examples)"
        )

    @pytest.mark.parametrize(
        ("path", "old", "new", "told"),
        [
            (
                f"{DETECTION}/templates/service.yaml",
                "{{- end }}\n{{- include",
                "{{- include",
                "error: appdefs/object-detection-fusion/charts/object-detection/templates/"
                "service.yaml:",
            ),
            (
                "appdefs/charts/ros-service/templates/_deployment.yaml",
                ".Values.replicas | int",
                ".Values.replicas | nonsense",
                "error: appdefs/charts/ros-service/templates/_deployment.yaml:",
            ),
            (
                f"{DETECTION}/templates/service.yaml",
                '{{- include "ros',
                'apiVersion: apps/v1\nkind: DaemonSet\nmetadata: {name: x}\n---\n{{ include "ros',
                "error: appdefs/object-detection-fusion/charts/object-detection: renders a "
                "DaemonSet, which is not among the kinds of access domain 'perception'",
            ),
        ],
        ids=["unclosed", "unknown function in the library", "forbidden kind"],
    )
    def test_what_helm_refuses_is_a_fault(
        self, checked: Any, path: str, old: str, new: str, told: str
    ) -> None:
        code, errors, _ = checked({path: (old, new)})
        assert code == 1
        assert [one for one in errors if one.startswith(told)], errors
