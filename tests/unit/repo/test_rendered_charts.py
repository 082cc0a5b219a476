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
        (
            "",
            ("apps", "DaemonSet"),
            f"list DaemonSet in 'kinds' in {DOMAINS} together with all kinds that the domain's "
            "charts have, because a list replaces the default kinds (docs/policy.md)",
        ),
        (KINDS, ("apps", "DaemonSet"), f"add DaemonSet to 'kinds' in {DOMAINS}"),
        (
            KINDS,
            ("example.org", "Robot"),
            f"add Robot, with its group and resource, to 'kinds' in {DOMAINS}",
        ),
        (
            "network: namespace",
            ("networking.k8s.io", "NetworkPolicy"),
            f"remove 'network: namespace' of the domain in {DOMAINS}",
        ),
    ],
)
def test_what_to_do_about_a_kind(field: str, kind: tuple[str, str], remedy: str) -> None:
    files = edited(
        DOMAINS, 'nodes: ["*"]', f'nodes: ["*"]\n    {field}' if field else 'nodes: ["*"]'
    )
    state = MemoryRepo(files).state
    release = next(one for found in trial_releases(state.config).values() for one in found)
    run = _Run(None, state)
    (fault,) = run._kinds_refused(Report((kind,)), release)
    assert fault.message == (
        f"renders a {kind[1]}, which is not among the kinds of access domain 'perception', so the "
        f"domain's cluster would refuse the object; {remedy}, or leave the object out"
    )
