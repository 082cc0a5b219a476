"""The manifests that clusters get in the golden cases."""

from __future__ import annotations

import json
from collections.abc import Iterator

import yaml

from tests.e2e.rig.cluster import Gitops
from tests.e2e.rig.kube import Manifest
from tests.kit.golden import CASES, whole

ARGOCD = "argocd-"  # the prefix of the cases for Argo CD


def golden(gitops: Gitops) -> Iterator[Manifest]:
    """Yield the distinct manifests of all golden cases for one controller."""
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
