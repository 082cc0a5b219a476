"""Manifests that golden cases or helm give a cluster."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from tests.e2e.rig.cluster import Gitops, Rig
from tests.e2e.rig.kube import Manifest
from tests.golden.cases import CASES, whole

ARGOCD = "argocd-"  # the prefix of the cases for Argo CD


def golden(gitops: Gitops) -> Iterator[Manifest]:
    seen: set[str] = set()
    cases = sorted(case for case in CASES if case.startswith(ARGOCD) == (gitops == "argocd"))
    for folder in ("bootstrap/", "clusters/"):
        for files in (files for case in cases for files in whole(case).values()):
            for path in sorted(path for path in files if path.startswith(folder)):
                for manifest in yaml.safe_load_all(files[path]):
                    text = json.dumps(manifest, sort_keys=True)
                    if manifest and text not in seen:
                        seen.add(text)
                        yield manifest


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
    rig.kube.apply(*made, dry_run=True)
    return {manifest["kind"] for manifest in made}
