"""Argo CD's own server accepts only the generator's signed calls."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from demandops.base.http_call import NoAnswer
from demandops.cluster import reconcile_trigger
from demandops_ros import DemandClient

from tests.e2e.common.access import access_file, documented_roles, limited
from tests.e2e.common.answers import TIMEOUT_S, fusion, push_chart, restart_generator
from tests.e2e.common.expected import CLUSTER
from tests.e2e.common.namespace import name_of
from tests.e2e.common.world import World
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.components import ARGOCD_SERVER, WEBHOOK_SECRET

OF_CHART = "\n---\napiVersion: v1\nkind: ConfigMap\nmetadata: {name: {{ .Release.Name }}-new}\n"


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    """A state repo whose generator calls Argo CD's webhook and may only read the cluster."""
    if rig.existing:
        pytest.skip("the tests do not know the webhook secret of an existing Argo CD")
    made = make_world()
    made.bootstrap(CLUSTER, rig)
    secret = made.folder / "secret"
    secret.touch(mode=0o600)
    secret.write_text(f"{WEBHOOK_SECRET}\n")
    rights = {
        namespace: [
            {**rule, "verbs": [verb for verb in rule["verbs"] if verb != "patch"]} for rule in rules
        ]
        for namespace, rules in documented_roles("argocd").items()
    }
    access = {
        "kubeconfig": limited(rig.kube, rig.kubeconfig, made.folder, rights),
        "webhook": f"{rig.parts.url(ARGOCD_SERVER)}/api/webhook",
        "secret_file": secret,
    }
    access_file(made.folder, {CLUSTER: access})
    restart_generator(made, TIMEOUT_S)
    return made


@pytest.fixture
def refreshed(rig: Rig) -> Callable[[], set[str]]:
    """Return a function that names what the webhook has refreshed since the last call."""
    seen: list[str] = []

    def names() -> set[str]:
        told = rig.parts.log(ARGOCD_SERVER).read_text(errors="replace").splitlines()
        new = [line for line in told if "from webhook" in line][len(seen) :]
        seen.extend(new)
        return {line.split("refreshing app '")[1].split("'")[0] for line in new}

    names()  # what was refreshed before the test does not count
    return names


def test_a_push_refreshes_only_what_changed(
    world: World, requester: DemandClient, refreshed: Callable[[], set[str]]
) -> None:
    requester.put("d", [fusion("vehicle00")], answer="healthy")
    refreshed()  # the first webhook call may refresh everything
    answer = requester.put("e", [fusion("vehicle00")], answer="healthy")
    assert all(path.startswith("ledger/") for path in world.changed_by(answer.commit))
    assert refreshed() == {world.domain.name}
    requester.release("e")


def test_healthy_means_that_a_chart_edited_in_its_folder_runs(
    world: World, requester: DemandClient, refreshed: Callable[[], set[str]]
) -> None:
    requester.put("d", [fusion("vehicle00")], answer="healthy")
    old = push_chart(world, OF_CHART)
    requester.put("d", [fusion("vehicle00", "vehicle01")], answer="healthy")
    made = {name_of(item) for item in world.domain.find("ConfigMap")}
    assert "od-edge-vehicle00-new" in made
    assert "od-edge-vehicle00" in refreshed()
    world.push(dict(old))
    requester.send({"operation": "release", "demand": "d", "answer": "healthy"})


@pytest.mark.parametrize("secret", [None, b"another"])
def test_a_call_with_another_signature_or_none_is_refused(
    world: World, rig: Rig, secret: bytes | None
) -> None:
    url = f"{rig.parts.url(ARGOCD_SERVER)}/api/webhook"
    pushed = (rig.git_url(world.name), "", world.tip(), None)
    with pytest.raises(NoAnswer, match=r"^it answered 400$"):
        reconcile_trigger.call_argocd(url, secret, *pushed)
    reconcile_trigger.call_argocd(url, WEBHOOK_SECRET.encode(), *pushed)
