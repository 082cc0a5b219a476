"""Charts: of a state repo, in a new version, and what helm and the API server say of one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from tests.e2e.rig.cluster import Rig

from .world import World

_CHARTS, _REGISTRY = "appdefs/object-detection-fusion/charts", "registry/charts.yaml"
DETECTION_TEMPLATE = f"{_CHARTS}/object-detection/templates/service.yaml"


def raised(world: World, name: str, version: str = "99.0.0") -> dict[str, str | None]:
    """Return the files that give a chart of the skeleton a new version."""
    file = f"{_CHARTS}/{name}/Chart.yaml"
    chart, registry = yaml.safe_load(world.file(file)), yaml.safe_load(world.file(_REGISTRY))
    chart["version"] = registry["charts"][name]["version"] = version
    return {file: yaml.safe_dump(chart), _REGISTRY: yaml.safe_dump(registry)}


def check_chart(
    rig: Rig,
    chart: Path,
    release: str,
    namespace: str,
    values: dict[str, Any],
    folder: Path,
    *,
    lint: bool = True,
) -> set[str]:
    """Lint and render a chart, have the server check the objects, and return their kinds."""
    given = folder / "values.json"
    given.write_text(json.dumps(values))
    if lint:
        rig.helm("lint", "--strict", "--quiet", f"--values={given}", str(chart))
    text = rig.helm("template", release, str(chart), f"-n={namespace}", f"--values={given}")
    made = [manifest for manifest in yaml.safe_load_all(text) if manifest]
    for manifest in made:  # `helm template` may leave out the namespace, which an install adds
        manifest["metadata"].setdefault("namespace", namespace)
        # rclpy refuses to unset a parameter, and with it all others
        assert manifest["kind"] != "ConfigMap" or "null" not in str(manifest["data"])
    rig.kube.apply(*made, dry_run=True)
    return {manifest["kind"] for manifest in made}
