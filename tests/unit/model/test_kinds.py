"""The Role, the AppProject and `check` permit the same kinds of objects in an access domain."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.decide import warnings
from demandops.model.config.load import load
from demandops.model.config.policy import KINDS, AccessDomain

from tests.kit.config import configuration, edited, skeleton
from tests.kit.memory import MemoryRepo

DOMAINS = "policy/access-domains.yaml"
APPDEFS = "appdefs/object-detection-fusion"
CHART = f"{APPDEFS}/charts/object-detection"
MONITOR = "{kind: ServiceMonitor, group: monitoring.coreos.com, resource: servicemonitors}"
REGISTERED = {
    "": "ConfigMap PersistentVolumeClaim Secret Service ServiceAccount",
    "apps": "Deployment StatefulSet",
    "autoscaling": "HorizontalPodAutoscaler",
    "batch": "CronJob Job",
    "networking.k8s.io": "Ingress NetworkPolicy",
    "policy": "PodDisruptionBudget",
    "rbac.authorization.k8s.io": "Role RoleBinding",
}


PAGE = (Path(__file__).parents[3] / "docs" / "policy.md").read_text()


def domain(**fields: Any) -> dict[str, str]:
    """Return the skeleton's policy, with these fields added to its access domain."""
    text = "".join(f"\n    {name}: {value}" for name, value in fields.items())
    return edited(DOMAINS, 'nodes: ["*"]', f'nodes: ["*"]{text}')


def bootstrap(files: Mapping[str, str]) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all(MemoryRepo(files).files["bootstrap/c-its.yaml"]))


def written(files: Mapping[str, str]) -> dict[str, set[str]]:
    """Return the resources that the domain's account may write, by API group."""
    (role,) = (item for item in bootstrap(files) if item["kind"] == "Role")
    found: dict[str, set[str]] = {}
    for rule in role["rules"]:
        if "create" in rule["verbs"] and "toolkit" not in rule["apiGroups"][0]:
            found.setdefault(rule["apiGroups"][0], set()).update(rule["resources"])
    return found


def permitted(files: Mapping[str, str]) -> set[tuple[str, str]]:
    """Return the (group, kind) pairs that the domain's AppProject permits."""
    argocd = {"demandops.yaml": skeleton("argocd")["demandops.yaml"]}
    (project,) = (item for item in bootstrap(argocd | dict(files)) if item["kind"] == "AppProject")
    return {
        (item["group"], item["kind"])
        for item in project["spec"]["namespaceResourceWhitelist"]
        if item["group"] != "argoproj.io"
    }


@pytest.mark.parametrize(
    "files",
    [
        {},
        domain(network="namespace"),
        domain(kinds=f"[ConfigMap, Secret, Deployment, DaemonSet, {MONITOR}]"),
    ],
)
def test_account_and_project_have_the_kinds_of_the_domain(files: dict[str, str]) -> None:
    kinds = load(configuration(files)).domains["perception"].allowed_kinds
    assert permitted(files) == {(kind.group, kind.kind) for kind in kinds}
    assert written(files) == {
        group: {kind.resource for kind in kinds if kind.group == group}
        for group in {kind.group for kind in kinds}
    }


def test_by_default_they_are_those_of_ordinary_charts() -> None:
    by_default = {(group, kind) for group, kinds in REGISTERED.items() for kind in kinds.split()}
    assert permitted({}) == by_default
    closed = by_default - {("networking.k8s.io", "NetworkPolicy")}
    assert permitted(domain(network="namespace")) == closed
    for group, kinds in REGISTERED.items():
        (row,) = (
            line
            for line in PAGE.splitlines()
            if line.startswith(f"| {(group and f'`{group}`') or 'core'} |")
        )
        assert re.findall(r"[A-Z]\w+", row.split("|")[2]) == kinds.split()


def test_the_list_of_the_documentation_is_taken() -> None:
    listed = re.search(r"^    kinds:\n(?:      .*\n)+", PAGE, re.MULTILINE)
    assert listed
    files = edited(DOMAINS, '    nodes: ["*"]\n', f'    nodes: ["*"]\n{listed[0]}')
    assert ("monitoring.coreos.com", "ServiceMonitor") in permitted(files)
    assert len(permitted(files)) == 4


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        (
            {"kinds": "[ConfigMap, Deployment, Secrets]"},
            ".kinds[2]: 'Secrets' is not a kind that one word can name; give kind, group and "
            "resource; did you mean 'Secret'?",
        ),
        (
            {"kinds": "[ConfigMap]"},
            ": kinds: lacks Deployment and Secret, but connections and Helm's releases need them; "
            "add what is missing",
        ),
        (
            {"kinds": f"[{', '.join(KINDS)}]", "network": "namespace"},
            ": kinds: NetworkPolicy lets a chart open what 'network: namespace' closes; "
            "remove NetworkPolicy from 'kinds', or remove 'network'",
        ),
    ],
)
def test_a_list_that_cannot_work_is_refused(fields: dict[str, str], told: str) -> None:
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(domain(**fields)))
    assert str(invalid.value) == f"{DOMAINS}: domains[0]{told}"


def test_the_schema_takes_a_word_or_a_kind() -> None:
    items = AccessDomain.model_json_schema()["properties"]["kinds"]["anyOf"][0]["items"]
    assert items["anyOf"][0]["enum"] == list(KINDS)


def warned(files: Mapping[str, str | None]) -> list[str]:
    return [str(found) for found in warnings.policy_warnings(MemoryRepo(files).state)]


def test_the_charts_that_come_with_it_need_no_more() -> None:
    assert warned({}) == []


def test_a_kind_that_the_domain_may_not_have_is_told_with_its_line() -> None:
    template = f"{CHART}/templates/agent.yaml"
    text = (
        "{{- if .Values.agent }}\napiVersion: apps/v1\nkind: DaemonSet # on each node\n{{- end }}\n"
    )
    assert warned({template: text}) == [
        f"{template}:3: DaemonSet is not among the kinds of access domain 'perception', so the "
        "cluster refuses such an object if the chart renders one; list DaemonSet in 'kinds' in "
        f"{DOMAINS} together with all kinds that the domain's charts have, because a list replaces "
        "the default kinds (docs/policy.md), or remove the object from the chart"
    ]
    (told,) = warned({template: text})
    assert told.replace(CHART, "appdefs/agent/charts/agent") in PAGE
    used = "ConfigMap, Deployment, HorizontalPodAutoscaler, Role, RoleBinding, Secret"
    kinds = f"[{used}, ServiceAccount, DaemonSet]"
    assert warned({template: text, **domain(kinds=kinds)}) == []


@pytest.mark.parametrize(
    ("fields", "kind", "remedy"),
    [
        (
            {"kinds": "[ConfigMap, Deployment, Secret, Role, RoleBinding, ServiceAccount]"},
            "DaemonSet",
            f"add DaemonSet to 'kinds' in {DOMAINS}",
        ),
        (
            {"network": "namespace"},
            "NetworkPolicy",
            f"remove 'network: namespace' of the domain in {DOMAINS}",
        ),
    ],
)
def test_a_remedy_can_be_followed(fields: dict[str, str], kind: str, remedy: str) -> None:
    """The remedy names the field that keeps the kind out: ``kinds`` or ``network``."""
    agent = {f"{CHART}/templates/agent.yaml": f"kind: {kind}\n"}
    found = [told for told in warned({**agent, **domain(**fields)}) if f"{CHART}/templ" in told]
    assert [f"one; {remedy}" in told for told in found if f": {kind} is" in told] == [True]


def test_a_domain_is_told_only_of_applications_that_its_rules_name() -> None:
    agent = {f"{CHART}/templates/agent.yaml": "kind: DaemonSet\n"}
    other = "[{name: all, applications: [other]}]"
    assert warned({**agent, **domain(rules=other)}) == []
    assert len(warned({**agent, **domain(rules='[{name: all, applications: ["object-*"]}]')})) == 1


def test_only_templates_that_helm_installs_are_searched_for_kinds() -> None:
    quiet = {
        f"{CHART}/templates/tests/connection.yaml": "kind: Pod\n",
        f"{CHART}/templates/NOTES.txt": "kind: DaemonSet\n",
        f"{CHART}/README.md": "kind: DaemonSet\n",
        f"{CHART}/templates/service.yaml": "apiVersion: v1\nkind: Service\nspec:\n  kind: Pod\n",
    }
    assert warned(quiet) == []
    below = {f"{CHART}/charts/sub/templates/a.yml": 'kind: "DaemonSet"\n'}
    assert warned(below)[0].startswith(f"{CHART}/charts/sub/templates/a.yml:1: DaemonSet is")


def test_what_cannot_be_known_is_said() -> None:
    chart = skeleton()[f"{CHART}/Chart.yaml"].partition("dependencies:")[0]
    files = {
        f"{CHART}/templates/any.yaml": "kind: {{ .Values.kind }}\n",
        f"{CHART}/crds/robot.yaml": "kind: CustomResourceDefinition\n",
        f"{CHART}/Chart.yaml": f"{chart}dependencies: [{{name: redis}}, {{name: sub}}]\n",
        f"{CHART}/charts/sub/Chart.yaml": "name: sub\nversion: 0.1.0\n",
    }
    assert warned(files) == [
        f"{CHART}/Chart.yaml: dependencies[0]: subchart 'redis' is not unpacked in charts/, so the "
        "kinds of its objects are not known; check yourself that the access domain allows these "
        "kinds",
        f"{CHART}/crds/robot.yaml: CustomResourceDefinition is not among the kinds of access "
        "domain 'perception', so the cluster refuses such an object if the chart renders one; list "
        f"CustomResourceDefinition, with its group and resource, in 'kinds' in {DOMAINS} together "
        "with all kinds that the domain's charts have, because a list replaces the default kinds "
        "(docs/policy.md), or remove the object from the chart",
        f"{CHART}/templates/any.yaml:1: the template computes the kind '{{{{ .Values.kind }}}}'; "
        "check yourself that the access domain allows it",
    ]
