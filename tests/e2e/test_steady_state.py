"""What nobody changed stays as it is, and what somebody changed by hand is restored."""

from __future__ import annotations

from typing import Any

import pytest

from tests.e2e.common import expected
from tests.e2e.common.domain import Domain
from tests.e2e.common.expected import (
    DETECTION,
    FUSION,
    WITHOUT_DEMANDS,
    source_end,
    target_end,
    unscheduled,
)
from tests.e2e.common.rendered import raised
from tests.e2e.common.world import World

PLAIN, OTHER = source_end("vehicle00"), target_end("station00")


def test_a_service_that_cannot_start_is_reconfigured_and_removed(
    world: World, edge_is_full: object
) -> None:
    """Later demands are applied without delay, although Helm waits five minutes by default."""
    domain = world.domain
    for step in (1, 2, 3):
        world.step(step, unscheduled(expected.after(step)))
    for step in (1, 2, 3):
        sent = world.demand(expected.demand(step) | {"shutdown": True})
    domain.follow(sent.commit)
    domain.wait_lines(WITHOUT_DEMANDS)


def requested_by(vehicle: str, goal: dict[str, Any]) -> dict[str, Any]:
    requesters = {"requester_ids": [vehicle, "station00"]}
    apps = [
        app | {"object_detection_fusion_app": app["object_detection_fusion_app"] | requesters}
        for app in goal["apps"]
    ]
    connections = [connection | requesters for connection in goal["connections"]]
    return goal | {"apps": apps, "connections": connections}


@pytest.fixture
def domain(world: World) -> Domain:
    """Demand step 1, and return the domain once everything is reconciled."""
    world.step(1, expected.after(1))
    world.domain.wait_releases()
    domain: Domain = world.domain
    return domain


def test_another_requester_changes_no_object_of_a_release(world: World, domain: Domain) -> None:
    before, releases = domain.wait_quiet(), domain.releases()
    goal = requested_by("vehicle03", expected.demand(1))
    sent = world.demand(goal)
    assert world.changed_by(sent.commit)
    assert all(path.startswith("ledger/") for path in world.changed_by(sent.commit))
    world.follow(sent, expected.after(1))
    domain.wait_checked(sent.commit)
    assert domain.wait_quiet(2.0) == before
    assert domain.releases() == releases
    world.follow(world.demand(goal | {"shutdown": True}), expected.after(1))
    assert domain.wait_quiet() == before
    assert domain.releases() == releases


def wait_restored(
    domain: Domain, template: dict[str, Any], data: dict[str, str], *names: str
) -> None:
    """Wait until a Deployment and a ConfigMap, of these names, are as they were."""
    deployment, config = names
    domain.wait("the image", lambda: domain.pod_template(deployment) == template)
    domain.wait("the content", lambda: domain.get("ConfigMap", config)["data"] == data)


def test_deleted_and_changed_objects_of_a_release_are_restored(domain: Domain) -> None:
    detection, params = DETECTION["vehicle00"], f"{FUSION}-params"
    template, inputs = domain.pod_template(detection), domain.get("ConfigMap", params)["data"]
    domain.change_image(detection)
    domain.overwrite(params, "params.yml")
    domain.restore(detection, FUSION)
    wait_restored(domain, template, inputs, detection, params)

    domain.kube.delete("ConfigMap", params, domain.namespace)
    domain.take_away("Deployment", detection)
    domain.restore(detection, FUSION)
    domain.wait_lines(expected.after(1))
    wait_restored(domain, template, inputs, detection, params)


def test_plain_manifests_and_releases_are_restored(domain: Domain) -> None:
    template, topics = domain.pod_template(PLAIN), domain.get("ConfigMap", PLAIN)["data"]
    domain.change_image(PLAIN)
    domain.overwrite(PLAIN, "params.yaml")
    gone = [("Deployment", OTHER), ("ConfigMap", OTHER), (domain.RELEASE, DETECTION["station00"])]
    for kind, name in gone:
        domain.take_away(kind, name)
    domain.restore()
    domain.wait_lines(expected.after(1))
    wait_restored(domain, template, topics, PLAIN, PLAIN)


@pytest.mark.only("flux", "only Flux makes an object of each version of a chart")
def test_a_new_version_of_a_chart_restarts_no_pod_that_it_does_not_change(
    world: World, domain: Domain
) -> None:
    domain.wait_quiet()
    charts, pods = domain.names("HelmChart"), domain.identity(FUSION)
    world.push(raised(world, "object-fusion"))
    sent = world.demand(requested_by("vehicle02", expected.demand(1)))  # contains the change
    world.follow(sent, expected.after(1))
    domain.wait_releases()
    assert domain.get("HelmRelease", FUSION)["status"]["history"][0]["chartVersion"][:4] == "99.0"
    assert domain.names("HelmChart") == charts - {"object-fusion-0.1.0"} | {"object-fusion-99.0.0"}
    assert domain.identity(FUSION) == pods
