"""A commit to an access domain's folder changes only the domain's own namespace.

Each case commits to the folder what a mistake or an attacker might commit.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.common import expected
from tests.e2e.common.intrusion import NEIGHBOUR, binding, config, privileged_deployment
from tests.e2e.common.world import World
from tests.e2e.conftest import SlipIn
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.components import ARGOCD as CONTROL
from tests.e2e.rig.kube import build_manifest

ARGOCD = "argoproj.io/v1alpha1"


@pytest.fixture(scope="module", autouse=True)
def unlimited_project(rig: Rig) -> Iterator[None]:
    """Make Argo CD's unlimited project `default`, which each installation of Argo CD has."""
    anywhere = {"server": "*", "namespace": "*"}
    spec = {
        "sourceRepos": ["*"],
        "destinations": [anywhere],
        "destinationServiceAccounts": [{**anywhere, "defaultServiceAccount": "default"}],
        "clusterResourceWhitelist": [{"group": "*", "kind": "*"}],
    }
    rig.kube.apply(build_manifest(ARGOCD, "AppProject", "default", CONTROL, spec=spec))
    yield
    rig.kube.delete("AppProject", "default", CONTROL)


REFUSED = {
    "a foreign namespace": (
        config("foreign", NEIGHBOUR),
        "namespace neighbour is not permitted in project 'demandops-perception'",
    ),
    "a kind of the whole cluster": (
        build_manifest("v1", "Namespace", "foreign"),
        "resource :Namespace is not permitted in project",
    ),
    "a binding for the whole cluster": (
        binding("ClusterRoleBinding"),
        "ClusterRoleBinding is not permitted in project",
    ),
    "more rights in its own namespace": (
        binding("RoleBinding", "perception"),
        "attempting to grant RBAC permissions not currently held",
    ),
    "a kind that the domain may not have": (
        build_manifest("apps/v1", "DaemonSet", "foreign", "perception", spec={}),
        "resource apps:DaemonSet is not permitted in project",
    ),
    "a privileged pod": privileged_deployment(),
    "a project": (
        build_manifest(ARGOCD, "AppProject", "foreign", "perception", spec={}),
        "AppProject is not permitted in project",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_and_services_run_on(world: World, slip_in: SlipIn, name: str) -> None:
    manifest, reason = REFUSED[name]
    domain, metadata = world.domain, manifest["metadata"]
    world.follow(world.demand(expected.demand(1)), expected.after(1))
    slip_in(manifest)
    domain.wait_refused(reason)
    assert domain.lines() == expected.after(1)
    if (namespace := metadata.get("namespace", "")) != "perception":
        object = manifest["kind"], metadata["name"], namespace, manifest["apiVersion"]
        assert domain.kube.get(*object) is None


@pytest.mark.parametrize(
    ("project", "namespace", "reason"),
    [
        pytest.param("default", "perception", "to use project", id="another project"),
        pytest.param("demandops-perception", "perception", "do not match", id="another namespace"),
        pytest.param(
            "default", CONTROL, "namespace argocd is not permitted", id="in Argo CD's own namespace"
        ),
    ],
)
def test_a_release_cannot_leave_its_namespace(
    world: World, slip_in: SlipIn, project: str, namespace: str, reason: str
) -> None:
    domain = world.domain
    spec = {
        "project": project,
        "source": {
            "repoURL": world.rig.git_url(world.name),
            "path": "appdefs/object-detection-fusion/charts/object-detection",
            "targetRevision": "main",
        },
        "destination": {"server": "https://kubernetes.default.svc", "namespace": NEIGHBOUR},
        "syncPolicy": {"automated": {}},
    }
    slip_in(build_manifest(ARGOCD, "Application", "foreign", namespace, spec=spec))
    domain.wait_refused(reason, "foreign")
    if namespace == CONTROL:
        assert domain.kube.get("Application", "foreign", CONTROL) is None
    assert domain.kube.find("Deployment", NEIGHBOUR) == []


def test_a_later_commit_is_applied_once_the_refused_manifest_is_gone(
    world: World, slip_in: SlipIn
) -> None:
    """The commit of the next demand removes the manifest, so Argo CD can apply this commit."""
    world.follow(world.demand(expected.demand(1)), expected.after(1))
    slip_in(config("foreign", NEIGHBOUR))
    world.step(2, expected.after(2))
