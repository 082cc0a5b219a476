"""What an access domain keeps apart: kinds of objects, credentials of brokers, nodes of pods.

`tests/e2e` shows what a cluster refuses by the rules for pods. The tests here translate the rule
for node selectors from CEL to Python and evaluate the result.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import pytest
import yaml
from demandops.decide.state import rendered_files
from demandops.model.config.base_model import matches
from demandops.model.config.load import load
from demandops.render.gitops import expression_of, node_rule
from demandops.repo.merge_check.rendered_charts import manifest_faults

from tests.kit import plain_yaml
from tests.kit.config import configuration, edited, skeleton
from tests.kit.connections import demand, routes
from tests.kit.memory import MemoryRepo
from tests.unit.model.test_config_mistakes import changed

DOMAINS, BROKERS = "policy/access-domains.yaml", "inventory/brokers.yaml"
MONITOR = "{kind: ServiceMonitor, group: monitoring.coreos.com, resource: servicemonitors}"
ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "policy.md").read_text()


def domain(**fields: Any) -> dict[str, str]:
    """Return the skeleton's policy, with these fields added to its access domain."""
    text = "".join(f"\n    {name}: {value}" for name, value in fields.items())
    return edited(DOMAINS, 'nodes: ["*"]', f'nodes: ["*"]{text}')


def written(files: Mapping[str, str]) -> dict[str, set[str]]:
    """Return the resources that the domain's account may write, by API group."""
    found: dict[str, set[str]] = {}
    for rule in bootstrap(files)["Role"]["rules"]:
        if "create" in rule["verbs"] and "toolkit" not in rule["apiGroups"][0]:
            found.setdefault(rule["apiGroups"][0], set()).update(rule["resources"])
    return found


def permitted(files: Mapping[str, str]) -> set[tuple[str, str]]:
    """Return the (group, kind) pairs that the domain's AppProject permits."""
    argocd = {"demandops.yaml": skeleton("argocd")["demandops.yaml"]}
    project = bootstrap(argocd | dict(files))["AppProject"]
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


def test_by_default_they_are_those_of_ordinary_charts_as_documented() -> None:
    table = PAGE[PAGE.index("| core |") :].partition("\n\n")[0]
    rows = [row.split("|")[1:3] for row in table.splitlines()]
    by_default = {
        (title.strip(" `").replace("core", ""), kind)
        for title, kinds in rows
        for kind in re.findall(r"[A-Z]\w+", kinds)
    }
    assert permitted({}) == by_default
    closed = by_default - {("networking.k8s.io", "NetworkPolicy")}
    assert permitted(domain(network="namespace")) == closed


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


# ---- the rules of a cluster for the pods of a domain ----


NODES = "inventory/nodes.yaml"
BOOTSTRAP = "bootstrap/c-its.yaml"
EXAMPLE = ROOT / "examples" / "policy" / "sensors-apart.yaml"
TEXTS = plain_yaml.beside(__file__, "pods-of-a-domain")
FILES = {DOMAINS: TEXTS["policy"], "inventory/nodes/own.yaml": TEXTS["nodes"]}


def taken(rule: str, selector: Mapping[str, str]) -> bool:
    """Return whether a rule for node selectors accepts a pod's node selector."""
    python = rule.replace("&&", "and").replace("||", "or").replace("variables.selector", "selector")
    python = re.sub(r'(selector\["\w+"\])\.matches\(', r"search(\1, ", python)
    scope = {
        "selector": selector,
        "true": True,
        "search": lambda text, found: re.search(found, text),
    }
    return bool(eval(python, {}, scope))  # noqa: S307 - our own text


def test_a_pod_selects_a_node_of_its_domain() -> None:
    config = load(configuration(FILES))
    for domain in config.domains.values():
        rule = node_rule("c-its", domain, config)
        for node in config.nodes.values():
            own = config.domain_of[node.id] is domain or node.labels == {"node_id": "own3"}
            assert taken(rule, node.labels) == own, (domain.name, node.id)
            assert taken(rule, node.labels | {"more": "narrower"}) == own
        for selector in ({}, {"node_id": "other"}, {"place": "x"}, {"kubernetes.io/os": "linux"}):
            assert not taken(rule, selector), selector


@pytest.mark.parametrize("seed", range(50))
def test_a_pattern_means_in_a_cluster_what_it_means_in_the_policy(seed: int) -> None:
    random = Random(seed)
    for _ in range(50):
        name = "".join(random.choices("ab.-_[]", k=random.randint(1, 5)))
        pattern = "".join(random.choice((one, one, "*", "?")) for one in name)
        other = "".join(random.choices("ab.-_[]", k=len(name)))
        for text in (name, other):
            found = bool(re.search(f"^({expression_of(pattern)})$", text))
            assert found == matches(text, (pattern,)), (pattern, text)


def test_a_node_without_labels_to_select_is_any() -> None:
    config = load(configuration(edited(NODES, "- id: cloud\n", "- id: cloud\n    selector: {}\n")))
    assert taken(node_rule("c-its", config.domains["perception"], config), {})


def bootstrap(files: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    text = rendered_files(MemoryRepo(files).state)[BOOTSTRAP].split("\n---\n", 1)[1]
    assert not [*manifest_faults({BOOTSTRAP: text})]
    return {item["kind"]: item for item in yaml.safe_load_all(text)}


OWN_LABELS = TEXTS["node"].replace("c-its}", "c-its, selector: {node_id: nine}}")
NEW_NODE = "inventory/nodes/new.yaml"
CHARTS, NEW = "registry/charts.yaml", "appdefs/new/charts/new"
CHART = {
    CHARTS: f"{skeleton()[CHARTS]}  new: {{folder: {NEW}, version: 1.0.0}}\n",
    f"{NEW}/Chart.yaml": "apiVersion: v2\nname: new\nversion: 1.0.0\n",
}


@pytest.mark.parametrize(
    ("gitops", "added", "changed"),
    [
        ("flux", {NEW_NODE: TEXTS["node"]}, set()),
        ("argocd", {NEW_NODE: TEXTS["node"]}, set()),
        ("flux", {NEW_NODE: OWN_LABELS}, {"c-its.yaml"}),
        ("flux", CHART, {"new-1.0.0.yaml"}),
    ],
    ids=["a vehicle", "a vehicle, by Argo CD", "labels of its own", "a chart in a new folder"],
)
def test_only_labels_of_its_own_change_what_someone_applied(
    gitops: str, added: dict[str, str], changed: set[str]
) -> None:
    """Nobody applies the bootstrap file again for a further vehicle or chart."""
    files = FILES | {"demandops.yaml": skeleton(gitops)["demandops.yaml"]}
    before = rendered_files(MemoryRepo(files).state)
    after = rendered_files(MemoryRepo(files | added).state)
    names = {path.rpartition("/")[2] for path in after if before.get(path) != after[path]}
    assert names == changed


LEVELS = {"baseline": 7, "host-network": 6, "privileged": 1}


@pytest.mark.parametrize("gitops", ["flux", "argocd"])
@pytest.mark.parametrize("level", LEVELS)
def test_each_level_has_its_label_and_rules(level: str, gitops: str) -> None:
    policy = edited(DOMAINS, "    podSecurity: host-network", f"    podSecurity: {level}")
    nodes = skeleton()[NODES].replace("    type:", "    hostNetwork: false\n    type:")
    files = policy | {NODES: nodes, "demandops.yaml": skeleton(gitops)["demandops.yaml"]}
    made = bootstrap(files)
    enforced = "baseline" if level == "baseline" else "privileged"
    assert made["Namespace"]["metadata"]["labels"] == {
        "demandops/pod-security": level,
        "pod-security.kubernetes.io/enforce": enforced,
    }
    policy, binding = (made[f"ValidatingAdmissionPolicy{kind}"] for kind in ("", "Binding"))
    rules = policy["spec"]["validations"]
    assert len(rules) == LEVELS[level]
    assert ("hostNetwork is not possible" in str(rules)) == (level == "baseline")
    used = {name for rule in rules for name in re.findall(r"variables\.(\w+)", rule["expression"])}
    assert used <= {variable["name"] for variable in policy["spec"]["variables"]}
    assert binding["spec"]["policyName"] == policy["metadata"]["name"]
    labels = binding["spec"]["matchResources"]["namespaceSelector"]["matchLabels"]
    assert labels == {"kubernetes.io/metadata.name": "perception"}


def test_the_example_of_the_documentation() -> None:
    policy = EXAMPLE.read_text()
    text = rendered_files(MemoryRepo({DOMAINS: policy}).state)[BOOTSTRAP]
    rules = {
        item["metadata"]["name"]: item["spec"]["validations"]
        for item in yaml.safe_load_all(text)
        if item["kind"] == "ValidatingAdmissionPolicy"
    }
    assert {name: len(found) for name, found in rules.items()} == {
        "demandops-perception": LEVELS["host-network"],
        "demandops-sensors": LEVELS["privileged"],
    }
    assert taken(rules["demandops-sensors"][0]["expression"], {"node_id": "station7"})
    (refusal,) = re.findall(r"^    Valid.* denied request: (.*)$", PAGE, re.MULTILINE)
    assert refusal in {rule["message"] for rule in rules["demandops-perception"]}


def test_the_default_lets_nodes_have_the_hosts_network() -> None:
    assert load(configuration()).domains["perception"].pod_security == "host-network"
    bare = skeleton()[DOMAINS].replace("    podSecurity: host-network\n", "")
    assert bare != skeleton()[DOMAINS]
    assert bootstrap({DOMAINS: bare}) == bootstrap({})
