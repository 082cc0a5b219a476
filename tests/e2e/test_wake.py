"""The generator makes the controller fetch, so a demand does not wait for the next fetch."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from demandops.base.http_call import NoAnswer
from demandops.cluster import reconcile_trigger
from demandops_ros import DemandClient

from tests.e2e.common import expected
from tests.e2e.common.access import access_file, documented_roles, limited, limited_world
from tests.e2e.common.expected import CLUSTER, STEPS, WITHOUT_DEMANDS
from tests.e2e.common.goals import application
from tests.e2e.common.rendered import DETECTION_TEMPLATE, raised
from tests.e2e.common.world import World
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.components import ARGOCD_SERVER, WEBHOOK_SECRET

ROUNDS = 3
"""How often the paper's eight demands are sent, one right after the other."""
OF_CHART = "\n---\napiVersion: v1\nkind: ConfigMap\nmetadata: {name: {{ .Release.Name }}-new}\n"


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    """A state repo that the controller fetches every ten minutes, if nobody triggers it."""
    return limited_world(make_world(), rig, interval="10m")


def test_a_demand_does_not_wait_for_the_next_fetch_and_a_burst_of_demands_leaves_nothing(
    world: World,
) -> None:
    """A busy Flux could forget an object that it is just creating, and then never remove it."""
    world.demand(expected.demand(1))
    world.domain.wait_lines(expected.after(1))
    for step in (*STEPS,) * ROUNDS:
        sent = world.demand(expected.demand(step))
    world.domain.wait_applied(sent.commit)
    world.domain.wait_lines(WITHOUT_DEMANDS)


@pytest.fixture
def webhook(world: World, rig: Rig) -> World:
    """Let the generator call Argo CD's webhook, with the right to read the cluster alone."""
    url = rig.parts.url(ARGOCD_SERVER)
    world.generator.stop()
    secret = world.folder / "secret"
    secret.touch(mode=0o600)
    secret.write_text(f"{WEBHOOK_SECRET}\n")
    rights = {
        namespace: [
            {**rule, "verbs": [verb for verb in rule["verbs"] if verb != "patch"]} for rule in rules
        ]
        for namespace, rules in documented_roles("argocd").items()
    }
    access = {
        "kubeconfig": limited(rig.kube, rig.kubeconfig, world.folder, rights),
        "webhook": f"{url}/api/webhook",
        "secret_file": secret,
    }
    file = access_file(world.folder, {CLUSTER: access})
    world.generator.start("--clusters", str(file))
    return world


@pytest.fixture
def refreshed(rig: Rig) -> Callable[[], set[str]]:
    """Return a function that names what the webhook has refreshed since the last call."""
    seen = 0

    def names() -> set[str]:
        nonlocal seen
        told = rig.parts.log(ARGOCD_SERVER).read_text(errors="replace").splitlines()
        new = [line for line in told if "from webhook" in line][seen:]
        seen += len(new)
        return {line.split("refreshing app '")[1].split("'")[0] for line in new}

    names()  # what was refreshed before the test does not count
    return names


@pytest.mark.only("argocd", "Flux's webhook is a program that the rig does not have")
def test_the_webhook_refreshes_what_a_push_changed_and_a_chart_edited_in_its_folder_runs(
    webhook: World, requester: DemandClient, refreshed: Callable[[], set[str]]
) -> None:
    world, vehicle = webhook, ["vehicle00"]
    fused = application("edge/fusion", ego_data=vehicle, point_cloud=vehicle)
    requester.put("d", [fused], answer="healthy")
    refreshed()  # the first call may refresh everything
    answer = requester.put("e", [fused], answer="healthy")
    assert all(path.startswith("ledger/") for path in world.changed_by(answer.commit))
    assert refreshed() == {world.domain.name}
    requester.release("e")

    edited = {DETECTION_TEMPLATE: world.file(DETECTION_TEMPLATE) + OF_CHART}
    world.push(raised(world, "object-detection") | edited)
    more = application("edge/fusion", ego_data=[*vehicle, "vehicle01"], point_cloud=vehicle)
    requester.put("d", [more], answer="healthy")
    assert "od-edge-vehicle00-new" in world.domain.names("ConfigMap")
    assert "od-edge-vehicle00" in refreshed()


@pytest.mark.only("argocd", "Flux's webhook is a program that the rig does not have")
@pytest.mark.parametrize("secret", [None, b"another"])
def test_a_call_with_another_signature_or_none_is_refused(
    world: World, rig: Rig, secret: bytes | None
) -> None:
    url = f"{rig.parts.url(ARGOCD_SERVER)}/api/webhook"
    pushed = (world.url, "", world.tip(), None)
    with pytest.raises(NoAnswer, match=r"^it answered 400$"):
        reconcile_trigger.call_argocd(url, secret, *pushed)
    reconcile_trigger.call_argocd(url, WEBHOOK_SECRET.encode(), *pushed)
