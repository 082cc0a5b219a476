"""The fault for an object whose kind the access domain does not allow says what to do."""

from __future__ import annotations

import pytest
from demandops.decide.changeset import trial_releases
from demandops.repo.pull_request.helm import Report
from demandops.repo.pull_request.rendered_charts import _Run

from tests.kit.config import edited
from tests.kit.memory import MemoryRepo

DOMAINS = "policy/access-domains.yaml"
KINDS = "kinds: [ConfigMap, Deployment, Secret]"


@pytest.mark.parametrize(
    ("field", "kind", "remedy"),
    [
        ("", "apps/DaemonSet", f"list DaemonSet in 'kinds' in {DOMAINS} together with all kinds"),
        (KINDS, "apps/DaemonSet", f"add DaemonSet to 'kinds' in {DOMAINS}"),
        (KINDS, "example.org/Robot", "add Robot, with its group and resource, to 'kinds'"),
        ("network: namespace", "networking.k8s.io/NetworkPolicy", "remove 'network: namespace'"),
    ],
)
def test_what_to_do_about_a_kind(field: str, kind: str, remedy: str) -> None:
    state = MemoryRepo(edited(DOMAINS, 'nodes: ["*"]', f'nodes: ["*"]\n    {field}')).state
    release = next(one for found in trial_releases(state.config).values() for one in found)
    group, _, name = kind.partition("/")
    (fault,) = _Run(None, state)._kinds_refused(Report(((group, name),)), release)
    assert f"renders a {name}, which is not among the kinds of access domain 'perc" in fault.message
    assert remedy in fault.message
