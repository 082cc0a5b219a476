"""Where what a demand needs is followed: by Flux's objects, or below an Application of Argo CD."""

from __future__ import annotations

import pytest
from demandops import strict_yaml
from demandops.cluster.health.release_health import ObjectName
from demandops.decision import decide
from demandops.service import rollout_targets

from tests.kit.golden import requests_of, start
from tests.kit.memory import NOW


@pytest.mark.parametrize(
    ("case", "application"),
    [("experiment", None), ("argocd-experiment", ObjectName("argocd", "demandops-perception"))],
)
def test_a_place_knows_by_which_controller_it_is_kept(
    case: str, application: ObjectName | None
) -> None:
    state, files = start(case)
    goal = strict_yaml.load(requests_of(case)[0].read_text())
    found = rollout_targets.targets_of_state(decide(state, goal, NOW, files.get).state)
    assert {target.name for release, target in found} == {release.name for release, _ in found}
    assert {target.domain.application for _, target in found} == {application}
    assert {target.by_helm for _, target in found} == {True, False}
