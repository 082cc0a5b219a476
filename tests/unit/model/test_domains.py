"""What an access domain keeps apart: the kinds of its objects, and the credentials of brokers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.model.config.load import load

from tests.kit.config import configuration, edited, skeleton
from tests.kit.connections import demand, routes
from tests.kit.memory import MemoryRepo
from tests.unit.model.test_config_mistakes import changed

DOMAINS, BROKERS = "policy/access-domains.yaml", "inventory/brokers.yaml"
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


def bootstrap(files: Mapping[str, str], kind: str) -> dict[str, Any]:
    documents = yaml.safe_load_all(MemoryRepo(files).files["bootstrap/c-its.yaml"])
    (found,) = (item for item in documents if item["kind"] == kind)
    return dict(found)


def written(files: Mapping[str, str]) -> dict[str, set[str]]:
    """Return the resources that the domain's account may write, by API group."""
    found: dict[str, set[str]] = {}
    for rule in bootstrap(files, "Role")["rules"]:
        if "create" in rule["verbs"] and "toolkit" not in rule["apiGroups"][0]:
            found.setdefault(rule["apiGroups"][0], set()).update(rule["resources"])
    return found


def permitted(files: Mapping[str, str]) -> set[tuple[str, str]]:
    """Return the (group, kind) pairs that the domain's AppProject permits."""
    argocd = {"demandops.yaml": skeleton("argocd")["demandops.yaml"]}
    project = bootstrap(argocd | dict(files), "AppProject")
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
        title = f"`{group}`" if group else "core"
        (row,) = re.findall(rf"^\| {title} \|(.*?)\|", PAGE, re.MULTILINE)
        assert re.findall(r"[A-Z]\w+", row) == kinds.split()


def test_the_list_of_the_documentation_is_taken() -> None:
    listed = re.search(r"^    kinds:\n(?:      .*\n)+", PAGE, re.MULTILINE)
    assert listed
    files = edited(DOMAINS, '    nodes: ["*"]\n', f'    nodes: ["*"]\n{listed[0]}')
    assert ("monitoring.coreos.com", "ServiceMonitor") in permitted(files)
    assert len(permitted(files)) == 4


# ---- credentials of brokers ----


def secrets(files: dict[str, Any]) -> dict[str, list[tuple[str, list[str]]]]:
    """Return the secrets and keys that the clients of a connection between two domains get."""
    books = MemoryRepo(changed({"base": "two domains"} | files))
    books.send(routes(demand()))
    pods = [item["spec"]["template"]["spec"] for item in books.objects("Deployment").values()]
    return {
        pod["nodeSelector"]["node_id"]: [
            (one["secret"]["secretName"], [item["key"] for item in one["secret"]["items"]])
            for one in pod["volumes"]
            if "secret" in one
        ]
        for pod in pods
    }


def test_each_end_of_a_connection_has_the_credentials_of_its_access_domain() -> None:
    credentials = "{edge: {secret: of-fleet, passwordKey: pw}}"
    own = {DOMAINS: {"namespace: fleet": f"…, brokerCredentials: {credentials}"}}
    of_fleet = ("of-fleet", ["username", "pw"])
    assert secrets(own) == {"vehicle00": [of_fleet], "edge": []}
    shared = {BROKERS: {"port: 1993": "…\n    credentials: {secret: all}"}}
    of_all = ("all", ["username", "password"])
    assert secrets(own | shared) == {"vehicle00": [of_fleet], "edge": [of_all]}


def test_the_credentials_of_the_documentation_are_taken() -> None:
    (example,) = re.findall(r"\n\n(    ros: .*\n(?:    .*\n)*)", PAGE)
    config = load(configuration({DOMAINS: f"{skeleton()[DOMAINS]}{example}"}))
    given = yaml.safe_load(example)
    assert {node.ros.domain_id for node in config.nodes.values()} == {given["ros"]["domainId"]}
    found = config.domains["perception"].broker_credentials
    secrets = {node: {"secret": one.secret} for node, one in found.items()}
    assert secrets == given["brokerCredentials"]
