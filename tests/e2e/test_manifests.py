"""The real helm and the API server's dry run accept the charts and all golden manifests."""

from __future__ import annotations

import copy
import json
import shutil
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base import strict_yaml
from demandops.repo.merge_check.rendered_charts import HELM_BIN

from tests.e2e.common.expected import NAMESPACE
from tests.e2e.common.rendered import DETECTION_TEMPLATE, check_chart
from tests.e2e.rig.cluster import Gitops, Rig
from tests.e2e.rig.kube import Manifest, build_manifest
from tests.golden.cases import CASES, rendered
from tests.kit.cli import Run
from tests.unit.render.test_inert import HELM_READS, TRAPS, UNSEEN

ROOT = Path(__file__).resolve().parents[2]
APPDEFS = (ROOT / "appdefs", ROOT / "examples" / "lane-detection" / "appdefs")
KINDS = {
    "flux": ("GitRepository", "Kustomization", "HelmRelease"),
    "argocd": ("Application", "AppProject"),
}
CHARTS = {
    "object-detection": "object-detection-fusion/charts/object-detection",
    "object-fusion": "object-detection-fusion/charts/object-fusion",
    "ros-launch": "lane-detection/charts/ros-launch",
}
VALUES: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("charts.yaml").read_text())
NOT_OF_A_CONTROLLER = pytest.mark.only("flux", "a chart does not depend on the controller")


def golden(gitops: Gitops) -> Iterator[Manifest]:
    """Yield each manifest of the golden cases for a controller once."""
    seen: set[str] = set()
    cases = sorted(case for case in CASES if case.startswith("argocd-") == (gitops == "argocd"))
    for folder in ("bootstrap/", "clusters/"):
        for files in (files for case in cases for files in rendered(case).values()):
            for path in sorted(path for path in files if path.startswith(folder)):
                for manifest in yaml.safe_load_all(files[path]):
                    text = json.dumps(manifest, sort_keys=True)
                    if manifest and text not in seen:
                        seen.add(text)
                        yield manifest


@pytest.fixture(scope="module", autouse=True)
def namespace(rig: Rig) -> None:
    rig.kube.apply(build_manifest("v1", "Namespace", NAMESPACE))


def test_the_server_takes_every_golden_manifest_and_no_unknown_field(rig: Rig) -> None:
    """The manifests use the controller's own kinds, whose CRDs the API server knows."""
    manifests, kinds = list(golden(rig.gitops)), (*KINDS[rig.gitops], "Deployment")
    assert {*kinds, "Role"} <= {manifest["kind"] for manifest in manifests}
    rig.kube.apply(*manifests, dry_run=True)
    for kind in kinds:
        broken = copy.deepcopy(next(item for item in manifests if item["kind"] == kind))
        broken["spec"]["interwal"] = "1m"
        with pytest.raises(Exception, match="field not declared in schema"):
            rig.kube.apply(broken, dry_run=True)


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


@NOT_OF_A_CONTROLLER
@pytest.mark.parametrize("chart", VALUES)
def test_a_chart_passes_lint_and_what_it_gives_the_server(
    rig: Rig, charts: dict[str, Path], tmp_path: Path, chart: str
) -> None:
    for values in VALUES[chart].values():
        kinds = check_chart(rig, charts[chart], "some-release", NAMESPACE, values, tmp_path)
        assert "Deployment" in kinds


@NOT_OF_A_CONTROLLER
def test_every_golden_release_gives_what_the_server_takes(
    rig: Rig, charts: dict[str, Path], tmp_path: Path
) -> None:
    releases = [manifest for manifest in golden("flux") if manifest["kind"] == "HelmRelease"]
    assert len(releases) > len(VALUES)
    for release in releases:
        name, values = release["metadata"]["name"], release["spec"]["values"]
        chart = charts["object-fusion" if name.startswith("of-") else "object-detection"]
        check_chart(rig, chart, name, NAMESPACE, values, tmp_path, lint=False)


@NOT_OF_A_CONTROLLER
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


@NOT_OF_A_CONTROLLER
def test_check_renders_each_application_and_names_what_helm_refuses(
    rig: Rig, checkout: Path, demandops: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(HELM_BIN, str(rig.helm_program))
    rendered = "charts rendered by helm: object-detection, object-fusion"
    checked = demandops("check", checkout, "--require-helm")
    assert (checked.code, checked.err) == (0, "")
    assert f"{rendered} (0 releases, 2 examples)" in checked.out

    new = ["new", "application", "tracking", "--input", "camera=sensor_msgs/msg/Image"]
    new += ["--image", "registry.example/tracking:1.0.0", "-C", str(checkout)]
    services = ["--service", "detector=a/d.launch.py", "--service", "tracker=a/t.launch.py"]
    assert demandops(*new, *services).code == 0
    checked = demandops("check", checkout, "--require-helm")
    assert f"{rendered}, tracking (0 releases, 4 examples)" in checked.out

    library = "appdefs/charts/ros-service/templates/_deployment.yaml"
    for path, old, broken in (
        (library, ".Values.replicas | int", ".Values.replicas | nonsense"),
        (DETECTION_TEMPLATE, "{{- end }}\n{{- include", "{{- include"),
    ):
        text = (checkout / path).read_text()
        (checkout / path).write_text(text.replace(old, broken, 1))
        checked = demandops("check", checkout, "--require-helm")
        assert checked.code == 1
        assert f"error: {path}:" in checked.err
        (checkout / path).write_text(text)
