"""An autoscaler sets the number of replicas, and the GitOps controller does not reset it."""

from __future__ import annotations

import re

from tests.e2e.common import expected
from tests.e2e.common.expected import CLUSTER, DETECTION, FUSION
from tests.e2e.common.rendered import raised
from tests.e2e.common.world import World
from tests.kit.config import override

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
DEPLOYMENT = "appdefs/charts/ros-service/templates/_deployment.yaml"
SCALING = "{min: 2, max: 4, autoscaler: {cpu: 70}, dividesWork: true}"
MANY = "overrides/many.yaml"
SCALED = {"services": ["object-detection"]}


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
        domain.follow(world.tip())

    def scale_and_change_image(to: int, *names: str) -> None:
        """Scale as an autoscaler does, change the images, and wait until these are restored."""
        for each in names:
            template = domain.pod_template(each)
            domain.kube.scale(each, to, domain.namespace)
            domain.change_image(each)
            domain.restore(each)
            domain.kube.wait("the image", lambda e=each, t=template: domain.pod_template(e) == t)

    original = world.file(APPDEF)
    merge(_autoscaled(world))
    domain.kube.apply(*world.manifests(CLUSTER))  # allows autoscalers
    domain.restore(*DETECTION.values(), FUSION)  # these releases failed without that right
    domain.kube.wait("an autoscaler", lambda: bounds() == (2, 4))
    domain.kube.wait("two replicas", lambda: (replicas(), replicas(FUSION)) == (2, 2))
    domain.wait_releases()
    scale_and_change_image(3, name, FUSION)
    assert (replicas(), replicas(FUSION)) == (3, 3)

    template = domain.pod_template(name)
    merge({MANY: override(SCALED, values={"podLabels": {"team": "perception"}})})
    domain.kube.wait("an upgrade", lambda: domain.pod_template(name) != template)
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
    appdef, deployment = world.file(APPDEF), world.file(DEPLOYMENT)
    unless_scaled = r"  \{\{- if not \.Values\.autoscaler \}\}\n(.*\n)  \{\{- end \}\}\n"
    assert re.search(unless_scaled, deployment)
    return raised(world, "object-fusion") | {
        APPDEF: re.sub(r"(    prefix: o[df]\n)", rf"\1    scaling: {SCALING}\n", appdef),
        DEPLOYMENT: re.sub(unless_scaled, r"\1", deployment),
    }
