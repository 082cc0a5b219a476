"""Another requester changes no release, and the controller undoes manual changes in the cluster."""

from __future__ import annotations

import yaml

from tests.e2e.common import expected
from tests.e2e.common.expected import FUSION
from tests.e2e.common.manual import requested_by
from tests.e2e.common.steps import (
    running,
    test_another_requester_changes_no_object_of_a_release,
    test_deleted_and_changed_objects_of_a_release_are_restored,
    test_plain_manifests_and_releases_are_restored,
)
from tests.e2e.rig.kube import Manifest

from .world import World

__all__ = [
    "test_another_requester_changes_no_object_of_a_release",
    "test_deleted_and_changed_objects_of_a_release_are_restored",
    "test_plain_manifests_and_releases_are_restored",
]
CHART = "appdefs/object-detection-fusion/charts/object-fusion/Chart.yaml"
REGISTRY = "registry/charts.yaml"


def test_a_new_version_of_a_chart_restarts_no_pod_that_it_does_not_change(
    world: World,
) -> None:
    domain = running(world)
    domain.wait_quiet()
    charts, pods = names(domain.find("HelmChart")), domain.identity(FUSION)
    chart, registry = yaml.safe_load(world.file(CHART)), yaml.safe_load(world.file(REGISTRY))
    old = f"object-fusion-{chart['version']}"
    chart["version"] = registry["charts"]["object-fusion"]["version"] = "99.0.0"
    world.push({CHART: yaml.safe_dump(chart), REGISTRY: yaml.safe_dump(registry)})
    sent = world.demand(
        requested_by("vehicle02", expected.demand(1))
    )  # its commit contains the change
    world.follow(sent, expected.after(1))
    domain.wait_releases()
    assert domain.get("HelmRelease", FUSION)["status"]["history"][0]["chartVersion"][:4] == "99.0"
    assert names(domain.find("HelmChart")) == charts - {old} | {"object-fusion-99.0.0"}
    assert domain.identity(FUSION) == pods


def names(items: list[Manifest]) -> set[str]:
    return {item["metadata"]["name"] for item in items}
