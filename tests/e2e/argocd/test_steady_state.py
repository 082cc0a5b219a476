"""Releases do not change without a demand: another requester, and manual changes."""

from __future__ import annotations

import pytest

from tests.e2e.common import expected
from tests.e2e.common.expected import DETECTION, FUSION, source_end, target_end
from tests.e2e.common.manual import (
    change_image,
    overwrite,
    pod_template,
    requested_by,
    wait_restored,
)

from .world import World

PLAIN, OTHER = source_end("vehicle00"), target_end("station00")


@pytest.fixture
def running(world: World) -> World:
    """The state repo after step 1, with nothing left to reconcile."""
    world.follow(world.demand(expected.demand(1)), expected.after(1))
    world.domain.wait_releases()
    return world


def test_another_requester_changes_no_object_of_a_release(running: World) -> None:
    domain = running.domain
    before, releases = domain.wait_quiet(), domain.releases()
    sent = running.demand(requested_by("vehicle03", expected.demand(1)))
    assert running.changed_by(sent.commit)
    assert all(path.startswith("ledger/") for path in running.changed_by(sent.commit))
    running.follow(sent, expected.after(1))
    for release in releases:
        domain.refresh(release)
    assert domain.wait_quiet(2.0) == before
    assert domain.releases() == releases
    goal = requested_by("vehicle03", expected.demand(1))
    running.follow(running.demand(goal | {"shutdown": True}), expected.after(1))
    assert domain.wait_quiet() == before
    assert domain.releases() == releases


def test_what_a_release_holds_is_restored(running: World) -> None:
    domain = running.domain
    detection, params = DETECTION["vehicle00"], f"{FUSION}-params"
    template, inputs = pod_template(domain, detection), domain.get("ConfigMap", params)["data"]
    change_image(domain, detection)
    overwrite(domain, params, "params.yml")
    wait_restored(domain, template, inputs, detection, params)

    domain.kube.delete("Deployment", detection, domain.namespace)
    domain.kube.delete("ConfigMap", params, domain.namespace)
    domain.wait_lines(expected.after(1))
    wait_restored(domain, template, inputs, detection, params)


def test_plain_manifests_and_releases_are_restored(running: World) -> None:
    domain = running.domain
    template, topics = pod_template(domain, PLAIN), domain.get("ConfigMap", PLAIN)["data"]
    change_image(domain, PLAIN)
    overwrite(domain, PLAIN, "params.yaml")
    gone = [("Deployment", OTHER), ("ConfigMap", OTHER), ("Application", DETECTION["station00"])]
    for kind, name in gone:
        domain.kube.delete(kind, name, domain.namespace)
    domain.wait_lines(expected.after(1))
    wait_restored(domain, template, topics, PLAIN, PLAIN)
