"""The real helm and the API server's dry run accept the charts and all golden manifests."""
# ruff: noqa: F401

from __future__ import annotations

import json
import shutil
from base64 import b64decode
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base import strict_yaml
from demandops.repo.merge_check.rendered_charts import HELM_BIN

from tests.e2e.common.expected import NAMESPACE
from tests.e2e.common.rendered import check_chart, golden
from tests.e2e.common.steps import (
    test_the_server_takes_every_golden_manifest_and_no_unknown_field,
)
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import build_manifest
from tests.kit.cli import Run
from tests.unit.render.test_inert import TRAPS, UNSEEN
from tests.unit.render.test_yaml_as_helm import HELM_READS

ROOT = Path(__file__).resolve().parents[3]
APPDEFS = (ROOT / "appdefs", ROOT / "examples" / "lane-detection" / "appdefs")
DETECTION = "appdefs/object-detection-fusion/charts/object-detection"
SERVICE, LIBRARY = f"{DETECTION}/templates/service.yaml", "appdefs/charts/ros-service/templates"
CHARTS = {
    "object-detection": "object-detection-fusion/charts/object-detection",
    "object-fusion": "object-detection-fusion/charts/object-fusion",
    "ros-launch": "lane-detection/charts/ros-launch",
}
VALUES: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("charts.yaml").read_text())
CASES = [pytest.param(c, v, id=f"{c} {n}") for c, cases in VALUES.items() for n, v in cases.items()]


@pytest.fixture(scope="module")
def charts(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the charts' folders by name, in a copy of `appdefs/` that helm may write to."""
    rig.kube.apply(build_manifest("v1", "Namespace", NAMESPACE))
    top = tmp_path_factory.mktemp("appdefs")
    for folder in reversed(APPDEFS):
        shutil.copytree(folder, top, dirs_exist_ok=True)
    found = {name: top / folder for name, folder in CHARTS.items()}
    for chart in found.values():
        rig.helm("dependency", "update", "--skip-refresh", str(chart))
    return found


def test_helm_reads_scalars_as_recorded_and_texts_as_we_write_them(
    rig: Rig, tmp_path: Path
) -> None:
    forms = {form: json.loads(by_helm) for form, by_helm in HELM_READS.items() if by_helm[0] != "r"}
    texts = [*TRAPS, *UNSEEN, *HELM_READS]
    (tmp_path / "templates").mkdir()
    (tmp_path / "Chart.yaml").write_text("{apiVersion: v2, name: probe, version: 0.1.0}")
    (tmp_path / "templates" / "read.yaml").write_text("read: {{ .Values | toJson | b64enc }}")
    values = "".join(f"- {form}\n" for form in forms)
    (tmp_path / "values.yaml").write_text(f"forms:\n{values}{strict_yaml.dump({'texts': texts})}")
    read = yaml.safe_load(rig.helm("template", "probe", str(tmp_path)))["read"]
    assert json.loads(b64decode(read)) == {"forms": [*forms.values()], "texts": texts}


@pytest.mark.parametrize(("chart", "values"), CASES)
def test_a_chart_passes_lint_and_what_it_gives_the_server(
    rig: Rig, charts: dict[str, Path], tmp_path: Path, chart: str, values: dict[str, Any]
) -> None:
    kinds = check_chart(rig, charts[chart], "some-release", NAMESPACE, values, tmp_path)
    assert "Deployment" in kinds


def test_every_golden_release_gives_what_the_server_takes(
    rig: Rig, charts: dict[str, Path], tmp_path: Path
) -> None:
    releases = [manifest for manifest in golden("flux") if manifest["kind"] == "HelmRelease"]
    assert len(releases) > len(VALUES)
    for release in releases:
        name, values = release["metadata"]["name"], release["spec"]["values"]
        chart = charts["object-fusion" if name.startswith("of-") else "object-detection"]
        check_chart(rig, chart, name, NAMESPACE, values, tmp_path, lint=False)


@pytest.fixture
def check(rig: Rig, checkout: Path, demandops: Run, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what runs `check` with the real helm; it gives code, errors and second line."""
    monkeypatch.setenv(HELM_BIN, str(rig.helm_program()))

    def check() -> tuple[int, list[str], str]:
        ran = demandops("check", checkout, "--require-helm")
        errors = [line for line in ran.err.splitlines() if "is still 0.1.0" not in line]
        return ran.code, errors, "".join(ran.out.splitlines()[1:2])

    return check


def test_what_init_laid_down_and_a_new_application_are_rendered(
    check: Any, checkout: Path, demandops: Run
) -> None:
    rendered = "charts rendered by helm: object-detection, object-fusion"
    assert check() == (0, [], f"{rendered} (0 releases, 2 examples)")
    new = ["new", "application", "tracking", "--input", "camera=sensor_msgs/msg/Image"]
    new += ["--image", "registry.example/tracking:1.0.0", "-C", str(checkout)]
    services = ["--service", "detector=a/d.launch.py", "--service", "tracker=a/t.launch.py"]
    assert demandops(*new, *services).code == 0
    assert check() == (0, [], f"{rendered}, tracking (0 releases, 4 examples)")


@pytest.mark.parametrize(
    ("path", "old", "new", "told"),
    [
        pytest.param(SERVICE, "{{- end }}\n{{- include", "{{- include", f"{SERVICE}:", id="open"),
        pytest.param(
            f"{LIBRARY}/_deployment.yaml",
            ".Values.replicas | int",
            ".Values.replicas | nonsense",
            f"{LIBRARY}/_deployment.yaml:",
            id="unknown function in the library",
        ),
        pytest.param(
            SERVICE,
            '{{- include "ros',
            'apiVersion: apps/v1\nkind: DaemonSet\nmetadata: {name: x}\n---\n{{ include "ros',
            f"{DETECTION}: renders a DaemonSet, which is not among the kinds of access domain 'p",
            id="forbidden kind",
        ),
    ],
)
def test_what_helm_refuses_is_a_fault(
    check: Any, checkout: Path, path: str, old: str, new: str, told: str
) -> None:
    text = (checkout / path).read_text()
    assert old in text
    (checkout / path).write_text(text.replace(old, new, 1))
    code, errors, _ = check()
    assert code == 1
    assert [one for one in errors if one.startswith(f"error: {told}")], errors
