"""The objects of Flux or Argo CD by which the generator sees how far a demand has got."""

from __future__ import annotations

import pytest
from demandops.base import strict_yaml
from demandops.cluster import rollouts
from demandops.cluster.health import ObjectName
from demandops.decide.decision import decide

from tests.kit import goals
from tests.kit.golden import requests_of, start
from tests.kit.memory import NOW, MemoryRepo


@pytest.mark.parametrize(
    ("case", "application"),
    [("experiment", None), ("argocd-experiment", ObjectName("argocd", "demandops-perception"))],
)
def test_a_rollout_target_names_its_argo_cd_application_or_none_for_flux(
    case: str, application: ObjectName | None
) -> None:
    state, files = start(case)
    goal = strict_yaml.load(requests_of(case)[0].read_text())
    found = rollouts.targets_of_state(decide(state, goal, NOW, files.get).state)
    assert {target.name for release, target in found} == {release.name for release, _ in found}
    assert {target.domain.application for _, target in found} == {application}
    assert {target.is_service for _, target in found} == {True, False}


def test_a_demand_waits_for_no_release_that_only_others_need() -> None:
    def join(cloud: goals.Topic) -> goals.Goal:
        return goals.goal([goals.application(who=[cloud[1]], clouds=[cloud])], id=cloud[1])

    def followed(goal: goals.Goal) -> dict[str, bool]:
        before = repo.state
        targets = rollouts.targets_of_decision(before, repo.send(goal))
        return {target.name: target.wanted for target in targets}

    repo, fusion = MemoryRepo(), "of-edge-object-detection-fusion-cf7e0180a8bb"
    vehicle, station = join(goals.CLOUD), join(goals.STATION_CLOUD)
    repo.send(vehicle)
    own = {fusion: True, "od-edge-station00": True}
    assert followed(station) == own
    assert followed(station) == own, "the demand was booked before"
    assert followed(vehicle | {"shutdown": True}) == {fusion: True, "od-edge-vehicle00": False}
