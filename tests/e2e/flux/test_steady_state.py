"""Releases do not change without a demand: another requester, and manual changes."""

from __future__ import annotations

import pytest
import yaml

from tests.e2e.common import expected
from tests.e2e.common.expected import DETECTION, FUSION, source_end, target_end
from tests.e2e.common.manual import (
    change_image,
    overwrite,
    pod_template,
    requested_by,
    wait_restored,
)
from tests.e2e.rig.kube import Manifest

from .view import Domain
from .world import World

PLAIN, OTHER = source_end("vehicle00"), target_end("station00")
CHART = "appdefs/object-detection-fusion/charts/object-fusion/Chart.yaml"
REGISTRY = "registry/charts.yaml"


@pytest.fixture
def running(world: World) -> World:
    """The state repo after step 1, with nothing left to reconcile."""
    world.follow(world.demand(expected.demand(1)), expected.after(1))
    world.domain.wait_releases()
    return world


def test_another_requester_changes_no_object_of_a_release(running: World) -> None:
    domain = running.domain
    before = domain.wait_quiet()
    sent = running.demand(requested_by("vehicle03", expected.demand(1)))
    assert running.changed_by(sent.commit)
    assert all(path.startswith("ledger/") for path in running.changed_by(sent.commit))
    running.follow(sent, expected.after(1))
    for chart in domain.find("HelmChart"):  # each HelmChart checks every commit
        name = chart["metadata"]["name"]
        domain.kube.wait(
            f"{name} to check the commit", lambda n=name: sent.commit in checked_commit(domain, n)
        )
    assert domain.wait_quiet(2.0) == before
    goal = requested_by("vehicle03", expected.demand(1))
    running.follow(running.demand(goal | {"shutdown": True}), expected.after(1))
    assert domain.wait_quiet() == before


def test_what_helm_deployed_is_restored(running: World) -> None:
    domain, namespace = running.domain, running.domain.namespace
    detection, params = DETECTION["vehicle00"], f"{FUSION}-params"

    def reconcile() -> None:
        for release in (detection, FUSION):
            domain.kube.reconcile("HelmRelease", release, namespace)

    template, inputs = pod_template(domain, detection), domain.get("ConfigMap", params)["data"]
    change_image(domain, detection)
    overwrite(domain, params, "params.yml")
    reconcile()
    wait_restored(domain, template, inputs, detection, params)

    domain.kube.delete("Deployment", detection, namespace)
    domain.kube.delete("ConfigMap", params, namespace)
    domain.kube.wait_gone("Deployment", detection, namespace)
    reconcile()
    domain.wait_lines(expected.after(1))
    wait_restored(domain, template, inputs, detection, params)


def test_plain_manifests_are_restored(running: World) -> None:
    domain, namespace = running.domain, running.domain.namespace
    template, topics = pod_template(domain, PLAIN), domain.get("ConfigMap", PLAIN)["data"]
    change_image(domain, PLAIN)
    overwrite(domain, PLAIN, "params.yaml")
    gone = [("Deployment", OTHER), ("ConfigMap", OTHER), ("HelmRelease", DETECTION["station00"])]
    for kind, name in gone:
        domain.kube.delete(kind, name, namespace)
        domain.kube.wait_gone(kind, name, namespace)
    domain.kube.reconcile("Kustomization", domain.name, namespace)
    domain.wait_lines(expected.after(1))
    wait_restored(domain, template, topics, PLAIN, PLAIN)


def test_a_new_version_of_a_chart_restarts_no_pod_that_it_does_not_change(
    running: World,
) -> None:
    domain = running.domain
    domain.wait_quiet()
    charts, pods = names(domain.find("HelmChart")), domain.identity(FUSION)
    chart, registry = yaml.safe_load(running.file(CHART)), yaml.safe_load(running.file(REGISTRY))
    old = f"object-fusion-{chart['version']}"
    chart["version"] = registry["charts"]["object-fusion"]["version"] = "99.0.0"
    running.push({CHART: yaml.safe_dump(chart), REGISTRY: yaml.safe_dump(registry)})
    sent = running.demand(
        requested_by("vehicle02", expected.demand(1))
    )  # its commit contains the change
    running.follow(sent, expected.after(1))
    domain.wait_releases()
    assert domain.get("HelmRelease", FUSION)["status"]["history"][0]["chartVersion"][:4] == "99.0"
    assert names(domain.find("HelmChart")) == charts - {old} | {"object-fusion-99.0.0"}
    assert domain.identity(FUSION) == pods


def names(items: list[Manifest]) -> set[str]:
    return {item["metadata"]["name"] for item in items}


def checked_commit(domain: Domain, chart: str) -> str:
    """Return the commit that a HelmChart has checked last."""
    status: dict[str, str] = domain.get("HelmChart", chart)["status"]
    return status.get("observedSourceArtifactRevision", "")
