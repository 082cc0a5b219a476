"""Tests that are the same with each controller.

A test module imports the tests that it runs. Its fixture `world` decides the controller.
"""

from __future__ import annotations

import copy
import re
from typing import Any

import pytest
import yaml

from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.components import KINDS
from tests.e2e.rig.kube import build_manifest
from tests.e2e.rig.tools import Report
from tests.kit.config import override

from . import expected
from .expected import (
    CLUSTER,
    DETECTION,
    FUSION,
    NAMESPACE,
    STEPS,
    WITHOUT_DEMANDS,
    source_end,
    target_end,
    unscheduled,
)
from .namespace import Namespace
from .rendered import golden
from .world import World, demandops, show_times

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
CHART = "appdefs/object-detection-fusion/charts/object-fusion"
SCALING = "{min: 2, max: 4, autoscaler: {cpu: 70}, dividesWork: true}"
MANY = "overrides/many.yaml"
SCALED = {"services": ["object-detection"]}
PLAIN, OTHER = source_end("vehicle00"), target_end("station00")


def test_eight_steps_and_the_fusion_is_never_restarted(world: World, say: Report) -> None:
    domain = world.domain
    times: dict[str, list[float]] = {}
    at_first = domain.inventory()
    fusion: list[tuple[object, ...]] = []
    for step in STEPS:
        times[f"{step} {expected.title(step)}"] = world.step(step, expected.after(step))
        domain.wait_releases()
        assert domain.lines() == expected.after(step), "the namespace changed again"
        if step < STEPS[-1]:
            fusion.append(domain.identity(FUSION))
    show_times(say, f"From the goal to the pods with {world.rig.gitops}, woken by the test", times)
    assert len(set(fusion)) == 1, f"the fusion was rolled out or restarted: {fusion}"
    domain.wait_inventory(at_first)


def test_a_service_that_cannot_start_is_reconfigured_and_removed(
    world: World, edge_is_full: object
) -> None:
    """Later demands are applied without delay, although Helm waits five minutes by default."""
    domain = world.domain
    for step in (1, 2, 3):
        sent = world.demand(expected.demand(step))
        domain.wake()
        domain.wait_applied(sent.commit)
        domain.wait_lines(unscheduled(expected.after(step)))
    for step in (1, 2, 3):
        sent = world.demand(expected.demand(step) | {"shutdown": True})
    domain.wake()
    domain.wait_applied(sent.commit)
    domain.wait_lines(WITHOUT_DEMANDS)


def requested_by(vehicle: str, goal: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of the goal whose requesters are ``vehicle`` and station00."""
    requesters = {"requester_ids": [vehicle, "station00"]}
    apps = [
        app | {"object_detection_fusion_app": app["object_detection_fusion_app"] | requesters}
        for app in goal["apps"]
    ]
    connections = [connection | requesters for connection in goal["connections"]]
    return goal | {"apps": apps, "connections": connections}


def pod_template(namespace: Namespace, deployment: str) -> dict[str, Any]:
    template: dict[str, Any] = namespace.get("Deployment", deployment)["spec"]["template"]
    return template


def change_image(namespace: Namespace, deployment: str) -> None:
    containers = pod_template(namespace, deployment)["spec"]["containers"]
    containers[0]["image"] = "example.invalid/other:1"
    body = {"spec": {"template": {"spec": {"containers": containers}}}}
    namespace.kube.patch("Deployment", deployment, body, namespace.namespace)
    changed = pod_template(namespace, deployment)["spec"]["containers"][0]["image"]
    assert changed == "example.invalid/other:1"


def overwrite(namespace: Namespace, config: str, key: str) -> None:
    namespace.kube.patch("ConfigMap", config, {"data": {key: "by hand"}}, namespace.namespace)
    assert namespace.get("ConfigMap", config)["data"] == {key: "by hand"}


def wait_restored(
    namespace: Namespace, template: dict[str, Any], data: dict[str, str], *names: str
) -> None:
    """Wait until a Deployment and a ConfigMap, of these names, are as they were."""
    deployment, config = names
    namespace.kube.wait("the image", lambda: pod_template(namespace, deployment) == template)
    namespace.kube.wait("the content", lambda: namespace.get("ConfigMap", config)["data"] == data)


def running(world: World) -> Namespace:
    """Demand step 1, and return the domain once everything is reconciled."""
    world.follow(world.demand(expected.demand(1)), expected.after(1))
    domain: Namespace = world.domain
    domain.wait_releases()
    return domain


def test_another_requester_changes_no_object_of_a_release(world: World) -> None:
    domain = running(world)
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


def test_deleted_and_changed_objects_of_a_release_are_restored(world: World) -> None:
    domain = running(world)
    detection, params = DETECTION["vehicle00"], f"{FUSION}-params"
    template, inputs = pod_template(domain, detection), domain.get("ConfigMap", params)["data"]
    change_image(domain, detection)
    overwrite(domain, params, "params.yml")
    domain.restore(detection, FUSION)
    wait_restored(domain, template, inputs, detection, params)

    domain.kube.delete("ConfigMap", params, domain.namespace)
    domain.take_away("Deployment", detection)
    domain.restore(detection, FUSION)
    domain.wait_lines(expected.after(1))
    wait_restored(domain, template, inputs, detection, params)


def test_plain_manifests_and_releases_are_restored(world: World) -> None:
    domain = running(world)
    template, topics = pod_template(domain, PLAIN), domain.get("ConfigMap", PLAIN)["data"]
    change_image(domain, PLAIN)
    overwrite(domain, PLAIN, "params.yaml")
    gone = [("Deployment", OTHER), ("ConfigMap", OTHER), (domain.RELEASE, DETECTION["station00"])]
    for kind, name in gone:
        domain.take_away(kind, name)
    domain.restore()
    domain.wait_lines(expected.after(1))
    wait_restored(domain, template, topics, PLAIN, PLAIN)


def test_an_autoscaler_owns_the_number_of_replicas(world: World) -> None:
    """The GitOps controller leaves the number of replicas to an autoscaler, if there is one.

    The cluster has no metrics, so its autoscaler only enforces the bounds, every 15 seconds. The
    fusion's chart sets a fixed number in its Deployment, as a third party's chart may do.
    """
    domain, name = world.domain, DETECTION["vehicle00"]

    def replicas(of: str = name) -> int | None:
        found = domain.kube.get("Deployment", of, domain.namespace)
        return int(found["spec"]["replicas"]) if found else None

    def bounds() -> tuple[int, int] | None:
        found = domain.kube.get("HorizontalPodAutoscaler", name, domain.namespace)
        return (found["spec"]["minReplicas"], found["spec"]["maxReplicas"]) if found else None

    def merge(files: dict[str, str | None]) -> None:
        """Push files, demand step 1, and wait until the newest commit is applied."""
        world.push(files)
        world.demand(expected.demand(1))
        domain.wake()
        domain.wait_applied(world.tip())

    def scale_and_change_image(to: int, *names: str) -> None:
        """Scale as an autoscaler does, change the images, and wait until these are restored."""
        for each in names:
            template = pod_template(domain, each)
            domain.kube.scale(each, to, domain.namespace)
            change_image(domain, each)
            domain.restore(each)
            domain.kube.wait("the image", lambda e=each, t=template: pod_template(domain, e) == t)

    original = world.file(APPDEF)
    merge(_autoscaled(world))
    domain.kube.apply(*world.manifests(CLUSTER))  # allows autoscalers
    domain.restore(*DETECTION.values(), FUSION)  # these releases failed without that right
    domain.kube.wait("an autoscaler", lambda: bounds() == (2, 4))
    domain.kube.wait("two replicas", lambda: (replicas(), replicas(FUSION)) == (2, 2))
    domain.wait_releases()
    scale_and_change_image(3, name, FUSION)
    assert (replicas(), replicas(FUSION)) == (3, 3)

    template = pod_template(domain, name)
    merge({MANY: override(SCALED, values={"podLabels": {"team": "perception"}})})
    domain.kube.wait("an upgrade", lambda: pod_template(domain, name) != template)
    domain.wait_releases()
    assert replicas() == 3
    merge({MANY: override(SCALED, replicas=4)})
    domain.kube.wait("both bounds", lambda: (bounds(), replicas()) == ((4, 4), 4))
    merge({MANY: None})
    domain.kube.wait("the former bounds", lambda: (bounds(), replicas()) == ((2, 4), 4))
    merge({APPDEF: original})
    domain.kube.wait("no autoscaler", lambda: (bounds(), replicas()) == (None, 1))
    scale_and_change_image(3, name)
    domain.kube.wait("the number of the definition", lambda: replicas() == 1)


def _autoscaled(world: World) -> dict[str, str | None]:
    """Return an appdef with autoscalers, and a fusion chart that sets the number of replicas."""
    chart, registry = f"{CHART}/Chart.yaml", "registry/charts.yaml"
    deployment = "appdefs/charts/ros-service/templates/_deployment.yaml"
    named = re.sub(
        r"  \{\{- if not \.Values\.autoscaler \}\}\n(.*\n)  \{\{- end \}\}\n",
        r"\1",
        world.file(deployment),
    )
    assert named != world.file(deployment)
    charts = yaml.safe_load(world.file(registry))
    charts["charts"]["object-fusion"]["version"] = "99.0.0"
    return {
        APPDEF: re.sub(
            r"(    prefix: o[df]\n)", rf"\1    scaling: {SCALING}\n", world.file(APPDEF)
        ),
        registry: yaml.safe_dump(charts),
        chart: world.file(chart).replace("version: 0.1.0", "version: 99.0.0"),
        deployment: named,
    }


def test_a_controller_that_was_not_retired_fails_and_changes_no_pod(world: World) -> None:
    """The state repo moves to the other controller while the cluster still runs the former one.

    docs/argocd.md says how to retire the former controller first. An operator cannot do so on a
    cluster that cannot be reached.
    """
    domain = world.domain
    own = world.rig.gitops
    other, foreign = ("argocd", "Application") if own == "flux" else ("flux", "HelmRelease")
    world.step(1, expected.after(1))
    domain.wait_releases()
    before, releases = domain.uids(), domain.releases()
    assert before
    assert len(releases) == 3

    demandops(world.folder, "upgrade", "--state-repo", world.push_url, "--gitops", other)
    domain.wake()
    domain.wait_attempted(world.tip())
    domain.kube.wait(  # each retry clears the error for a moment
        f"the controller to fail on each {foreign}", lambda: foreign in domain.folder_trouble()
    )
    assert domain.uids() == before
    assert domain.releases() == releases

    demandops(world.folder, "upgrade", "--state-repo", world.push_url, "--gitops", own)
    domain.wake()
    domain.wait_applied(world.tip())
    assert domain.uids() == before
    for step in (2, 3):
        world.step(step, expected.after(step))


def test_the_server_takes_every_golden_manifest_and_no_unknown_field(rig: Rig) -> None:
    """The manifests use the controller's own kinds, whose CRDs the API server knows."""
    rig.kube.apply(build_manifest("v1", "Namespace", NAMESPACE))
    manifests, kinds = list(golden(rig.gitops)), (*KINDS[rig.gitops], "Deployment")
    assert {*kinds, "Role"} <= {manifest["kind"] for manifest in manifests}
    rig.kube.apply(*manifests, dry_run=True)
    for kind in kinds:
        broken = copy.deepcopy(next(item for item in manifests if item["kind"] == kind))
        broken["spec"]["interwal"] = "1m"
        with pytest.raises(Exception, match="field not declared in schema"):
            rig.kube.apply(broken, dry_run=True)
