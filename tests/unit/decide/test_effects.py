"""Whether the pods of a release start, restart, take over new values, or stop."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from demandops.decide.state import ReleaseChange, describe_change, planned_releases
from demandops.render import gitops

from tests.kit.config import edited, override, skeleton
from tests.kit.goals import Goal, put
from tests.kit.memory import MemoryRepo

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
FUSION = "of-edge-fusion-c9b035cdedb8"


def demand(vehicle: str) -> Goal:
    topic = f"/vehicles/{vehicle}/ego_data", vehicle
    return put(vehicle, vehicle, id="edge/fusion", topic=topic)


def effects(repo: MemoryRepo, goal: object) -> dict[str, str]:
    return {each.name: each.effect for each in repo.send(goal).releases}


@pytest.mark.parametrize("gitops", ["flux", "argocd"])
def test_an_input_reconfigures_a_service_that_takes_it_over(gitops: str) -> None:
    files = {path: text for path, text in skeleton(gitops).items() if path == "demandops.yaml"}
    live, cold = MemoryRepo(files), MemoryRepo(files | edited(APPDEF, "    live: [inputs]\n", ""))
    for repo in (live, cold):
        assert effects(repo, demand("vehicle00"))[FUSION] == "starts"
    assert effects(live, demand("vehicle01"))[FUSION] == "reconfigures"
    assert effects(cold, demand("vehicle01"))[FUSION] == "restarts"
    ended = {"kind": "Demand", "operation": "release"}
    gone = [
        effects(live, ended | {"demand": vehicle, "requesters": [vehicle]})
        for vehicle in ("vehicle00", "vehicle01")
    ]
    assert (gone[0][FUSION], {*gone[1].values()}) == ("reconfigures", {"stops"})


@pytest.mark.parametrize(
    ("changed", "effect"),
    [
        ({"values": {"inputs": {"egoData": ["/other"]}}}, "reconfigures"),
        ({"replicas": 0}, "stops"),
        ({"values": {"inputs": {"egoData": ["/other"]}, "fusion": {"nodeName": "x"}}}, "restarts"),
        ({"images": {"object-fusion": {"tag": "2"}}}, "restarts"),
        ({"hold": True}, ""),
    ],
)
def test_an_override_has_the_effect_of_what_it_changes(
    changed: dict[str, Any], effect: str
) -> None:
    text = override({"services": ["object-fusion"]}, **changed)
    before, after = MemoryRepo(), MemoryRepo({"overrides/test.yaml": text})
    for repo in (before, after):
        repo.send(demand("vehicle00"))
    assert change_between(before, after).effect == effect


def change_between(before: MemoryRepo, after: MemoryRepo) -> ReleaseChange:
    def of(repo: MemoryRepo) -> tuple[Any, str]:
        (path,) = (path for path in repo.files if path.endswith(f"/{FUSION}.yaml"))
        by_name = {release.name: release for release in planned_releases(repo.state).values()}
        return by_name[FUSION], repo.files[path]

    (was, current), (now, text) = of(before), of(after)
    return describe_change(was, now, current, text)


@pytest.mark.parametrize("gitops_controller", ["flux", "argocd"])
def test_values_are_read_from_a_text_as_yaml_has_them(gitops_controller: str) -> None:
    repo = MemoryRepo({"demandops.yaml": skeleton(gitops_controller)["demandops.yaml"]})
    repo.send(demand("vehicle00"))
    texts = [text for path, text in repo.files.items() if f"/{FUSION}.yaml" in path]
    values, rest = gitops.values_apart(texts[0])
    spec = yaml.safe_load(texts[0])["spec"]
    written = spec.get("values") or spec["source"]["helm"]["valuesObject"]
    assert {
        name: yaml.safe_load(f"{name}:{text}")[name] for name, text in values.items()
    } == written
    assert not values.keys() & {*rest.split()}
