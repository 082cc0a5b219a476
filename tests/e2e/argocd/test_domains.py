"""A commit to an access domain's folder changes only the domain's own namespace.

Each case commits to the folder what a mistake or an attacker might commit.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator

import pytest

from tests.e2e.common import expected
from tests.e2e.common.intrusion import FILE, FORBIDDEN, NEIGHBOUR, binding, makers
from tests.e2e.rig.argocd import NAMESPACE as CONTROL
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import Manifest, build_manifest

from .world import World

IN_CLUSTER = "https://kubernetes.default.svc"

SlipIn = Callable[[Manifest], None]


@pytest.fixture(scope="module", autouse=True)
def neighbour(rig: Rig) -> Iterator[None]:
    """Make a namespace outside all access domains, and Argo CD's unlimited project `default`.

    Each installation of Argo CD has that project.
    """
    rig.kube.apply({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NEIGHBOUR}})
    anywhere = {"server": "*", "namespace": "*"}
    account = {**anywhere, "defaultServiceAccount": "default"}
    spec = {
        "sourceRepos": ["*"],
        "destinations": [anywhere],
        "destinationServiceAccounts": [account],
        "clusterResourceWhitelist": [{"group": "*", "kind": "*"}],
    }
    rig.kube.apply(
        build_manifest("argoproj.io/v1alpha1", "AppProject", "default", CONTROL, spec=spec)
    )
    yield
    rig.kube.delete("AppProject", "default", CONTROL)
    rig.kube.delete("Namespace", NEIGHBOUR)


@pytest.fixture
def slip_in(world: World) -> Iterator[SlipIn]:
    """Return a function that commits a manifest to the domain's folder.

    The fixture removes the manifest after the test.
    """

    def push(manifest: Manifest) -> None:
        commit = world.push({FILE: json.dumps(manifest)})
        world.domain.wake()
        world.domain.wait_fetched(commit)

    yield push
    world.tip()  # tip() updates the clone
    if FILE in world.person.git("ls-files").split():
        world.push({FILE: None})
    world.domain.wake()
    world.domain.wait_applied(world.tip())


def application(world: World, *, project: str, into: str, namespace: str) -> Manifest:
    """Return an Application of `project`, in `namespace`, that installs the detection in `into`."""
    source = {
        "repoURL": world.rig.git_url(world.name),
        "path": "appdefs/object-detection-fusion/charts/object-detection",
        "targetRevision": "main",
    }
    spec = {
        "project": project,
        "source": source,
        "destination": {"server": IN_CLUSTER, "namespace": into},
        "syncPolicy": {"automated": {}},
    }
    return build_manifest("argoproj.io/v1alpha1", "Application", "foreign", namespace, spec=spec)


REFUSED = {
    "a foreign namespace": (
        build_manifest("v1", "ConfigMap", "foreign", NEIGHBOUR, data={"made": "by hand"}),
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
    "a privileged pod": (list(makers(FORBIDDEN["privileged"][0]))[1], FORBIDDEN["privileged"][1]),
    "a project": (
        build_manifest("argoproj.io/v1alpha1", "AppProject", "foreign", "perception", spec={}),
        "AppProject is not permitted in project",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_and_services_run_on(world: World, slip_in: SlipIn, name: str) -> None:
    manifest, reason = REFUSED[name]
    domain = world.domain
    world.follow(world.demand(expected.demand(1)), expected.after(1))
    slip_in(manifest)
    domain.kube.wait(
        f"the refusal of {name}", lambda: reason in domain.trouble(domain.name, CONTROL)
    )
    assert domain.lines() == expected.after(1)
    if manifest["metadata"].get("namespace") != "perception":
        namespace = manifest["metadata"].get("namespace", "")
        assert (
            domain.kube.get(
                manifest["kind"], manifest["metadata"]["name"], namespace, manifest["apiVersion"]
            )
            is None
        )


def test_a_release_cannot_name_another_project(world: World, slip_in: SlipIn) -> None:
    slip_in(application(world, project="default", into=NEIGHBOUR, namespace="perception"))
    domain = world.domain
    domain.kube.wait(
        "the refusal", lambda: "to use project" in domain.trouble("foreign", "perception")
    )
    assert domain.kube.find("Deployment", NEIGHBOUR) == []


def test_a_release_cannot_leave_its_namespace(world: World, slip_in: SlipIn) -> None:
    project = world.domain.name
    slip_in(application(world, project=project, into=NEIGHBOUR, namespace="perception"))
    domain = world.domain
    domain.kube.wait(
        "the refusal", lambda: "do not match" in domain.trouble("foreign", "perception")
    )
    assert domain.kube.find("Deployment", NEIGHBOUR) == []


def test_no_application_in_argo_cds_own_namespace(world: World, slip_in: SlipIn) -> None:
    slip_in(application(world, project="default", into=NEIGHBOUR, namespace=CONTROL))
    domain = world.domain
    domain.kube.wait(
        "the refusal",
        lambda: "namespace argocd is not permitted" in domain.trouble(domain.name, CONTROL),
    )
    assert domain.kube.get("Application", "foreign", CONTROL) is None
    assert domain.kube.find("Deployment", NEIGHBOUR) == []


def test_a_later_commit_is_applied_once_the_refused_manifest_is_gone(
    world: World, slip_in: SlipIn
) -> None:
    """The commit of the next demand removes the manifest, so Argo CD can apply this commit."""
    world.follow(world.demand(expected.demand(1)), expected.after(1))
    slip_in(build_manifest("v1", "ConfigMap", "foreign", NEIGHBOUR, data={"made": "by hand"}))
    world.step(2, expected.after(2))
