"""The golden folders' manifests that a cluster gets."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import yaml

from tests.e2e.rig.cluster import Gitops
from tests.e2e.rig.kube import Manifest

GOLDEN = Path(__file__).resolve().parents[2] / "golden"
ARGOCD = "argocd-"  # what the names of its cases begin with


def golden(gitops: Gitops) -> Iterator[Manifest]:
    """Every manifest for one controller, each once."""
    seen: set[str] = set()
    for folder in ("bootstrap", "clusters"):
        for file in sorted(GOLDEN.glob(f"*/expected/*/{folder}/**/*.yaml")):
            if file.relative_to(GOLDEN).parts[0].startswith(ARGOCD) != (gitops == "argocd"):
                continue
            for manifest in yaml.safe_load_all(file.read_text()):
                text = json.dumps(manifest, sort_keys=True)
                if manifest and text not in seen:
                    seen.add(text)
                    yield manifest
