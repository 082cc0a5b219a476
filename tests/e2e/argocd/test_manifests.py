"""Golden manifests before the judge: the API server's dry run, with Argo CD's own definitions."""

from __future__ import annotations

import copy

import pytest

from tests.e2e.common.golden import golden
from tests.e2e.rig.cluster import Rig

from .world import World


def test_the_server_takes_every_golden_manifest(rig: Rig, world: World) -> None:
    manifests = list(golden("argocd"))
    kinds = {manifest["kind"] for manifest in manifests}
    assert {"Application", "AppProject", "Deployment", "Role"} <= kinds
    rig.kube.apply(*manifests, dry_run=True)


@pytest.mark.parametrize("kind", ["Application", "AppProject"])
def test_the_server_does_look(rig: Rig, world: World, kind: str) -> None:
    """The dry run means something: a field that does not exist is not taken."""
    broken = copy.deepcopy(next(item for item in golden("argocd") if item["kind"] == kind))
    broken["spec"]["sink"] = "1m"
    with pytest.raises(Exception, match="field not declared in schema"):
        rig.kube.apply(broken, dry_run=True)
