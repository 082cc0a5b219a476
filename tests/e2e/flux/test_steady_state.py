"""Another requester changes no release, and the controller undoes manual changes in the cluster."""
# ruff: noqa: F401

from __future__ import annotations

import yaml

from tests.e2e.common import expected
from tests.e2e.common.expected import FUSION
from tests.e2e.common.namespace import Namespace, name_of
from tests.e2e.common.steps import (
    requested_by,
    running,
    test_another_requester_changes_no_object_of_a_release,
    test_deleted_and_changed_objects_of_a_release_are_restored,
    test_plain_manifests_and_releases_are_restored,
)
from tests.e2e.common.world import World

CHART = "appdefs/object-detection-fusion/charts/object-fusion/Chart.yaml"
REGISTRY = "registry/charts.yaml"


def test_a_new_version_of_a_chart_restarts_no_pod_that_it_does_not_change(world: World) -> None:
    domain = running(world)
    domain.wait_quiet()
    charts, pods = helm_charts(domain), domain.identity(FUSION)
    chart, registry = yaml.safe_load(world.file(CHART)), yaml.safe_load(world.file(REGISTRY))
    old = f"object-fusion-{chart['version']}"
    chart["version"] = registry["charts"]["object-fusion"]["version"] = "99.0.0"
    world.push({CHART: yaml.safe_dump(chart), REGISTRY: yaml.safe_dump(registry)})
    sent = world.demand(requested_by("vehicle02", expected.demand(1)))  # contains the change
    world.follow(sent, expected.after(1))
    domain.wait_releases()
    assert domain.get("HelmRelease", FUSION)["status"]["history"][0]["chartVersion"][:4] == "99.0"
    assert helm_charts(domain) == charts - {old} | {"object-fusion-99.0.0"}
    assert domain.identity(FUSION) == pods


def helm_charts(domain: Namespace) -> set[str]:
    return {name_of(item) for item in domain.find("HelmChart")}
