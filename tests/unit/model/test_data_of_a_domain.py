"""ROS domains and the credentials of brokers keep the data of access domains apart."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from demandops.decide import warnings
from demandops.model.config.load import load

from tests.kit.config import configuration, skeleton, state_of
from tests.kit.memory import MemoryRepo

DOMAINS, NODES = "policy/access-domains.yaml", "inventory/nodes.yaml"
BROKERS = "inventory/brokers.yaml"
PAGE = (Path(__file__).parents[3] / "docs" / "policy.md").read_text()
BOTH = 'rules: [{name: all, peers: ["*"]}]'
CONNECTION = {
    "kind": "Demand",
    "demand": "d",
    "requesters": ["vehicle00"],
    "connections": [
        {"id": "c", "source": "vehicle00", "target": "edge", "topics": [{"source": "/a"}]}
    ],
}


def domains(fleet: str = "", city: str = "") -> dict[str, str]:
    """Return a policy with two access domains, which have these further fields.

    By default, a domain has a rule that permits everything.
    """
    return {
        DOMAINS: f"""
apiVersion: demandops/v1
kind: AccessDomains
domains:
  - {{name: fleet, namespace: fleet, nodes: ["vehicle*"], {fleet or BOTH}}}
  - {{name: city, namespace: city, nodes: [station00, edge, cloud], {city or BOTH}}}
"""
    }


def secrets(files: dict[str, str]) -> dict[str, list[tuple[str, list[str]]]]:
    """Return the secrets and keys that the clients of a connection between both domains get."""
    books = MemoryRepo(files)
    books.send(CONNECTION)
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
    own = domains(f"{BOTH}, brokerCredentials: {{edge: {{secret: of-fleet, passwordKey: pw}}}}")
    of_fleet = ("of-fleet", ["username", "pw"])
    assert secrets(own) == {"vehicle00": [of_fleet], "edge": []}
    shared = skeleton()[BROKERS].replace("port: 1993", "port: 1993\n    credentials: {secret: all}")
    assert secrets(own | {BROKERS: shared}) == {
        "vehicle00": [of_fleet],
        "edge": [("all", ["username", "password"])],
    }


POD_NETWORK = {NODES: skeleton()[NODES].replace("    type:", "    hostNetwork: false\n    type:")}
TWO_CLUSTERS = {
    NODES: re.sub(r"(?<=type: vehicle\n    cluster: )c-its", "fleet", skeleton()[NODES]),
    "inventory/clusters.yaml": skeleton()["inventory/clusters.yaml"] + "  - name: fleet\n",
}
SHARED = "access domains 'city' and 'fleet' share ROS domain 0 on the network of the hosts of "
CLOSED = (
    "'network: namespace' of access domain 'fleet' has no effect on nodes whose pods use the "
    "host's network: 'vehicle00', 'vehicle01', 'vehicle02' and 1 more"
)


@pytest.mark.parametrize(
    ("files", "told"),
    [
        (domains(), [SHARED]),
        (domains("ros: {domainId: 1}", "ros: {domainId: 2}"), []),
        (domains("network: namespace, ros: {domainId: 1}"), [CLOSED]),
        (domains("network: namespace") | POD_NETWORK, []),
        (domains() | TWO_CLUSTERS, []),
    ],
    ids=["one ROS domain", "two", "host's network", "pods' network", "two clusters"],
)
def test_what_the_hosts_network_leaves_open_is_told(files: dict[str, str], told: list[str]) -> None:
    found = [str(one) for one in warnings.policy_warnings(MemoryRepo(files).state)]
    assert all(
        one.startswith(f"{DOMAINS}: {words}") for one, words in zip(found, told, strict=True)
    )


def test_connections_that_could_not_be_demanded_any_longer_are_told() -> None:
    books = MemoryRepo(domains("ros: {domainId: 1}, " + BOTH))
    books.send(CONNECTION)
    assert list(warnings.policy_warnings(books.state)) == []
    config = load(configuration(domains("ros: {domainId: 1}")))
    (told,) = map(str, warnings.policy_warnings(state_of(config, books.state.ledger)))
    assert "no rule of access domain 'fleet' has 'city' among its 'peers'" in told
    assert told.endswith("claims on such connections stay in effect: 1")


def test_the_example_of_the_documentation() -> None:
    (example,) = re.findall(r"\n\n(    ros: .*\n(?:    .*\n)*)", PAGE)
    config = load(configuration({DOMAINS: f"{skeleton()[DOMAINS]}{example}"}))
    given = yaml.safe_load(example)
    assert {node.ros.domain_id for node in config.nodes.values()} == {given["ros"]["domainId"]}
    found = config.domains["perception"].broker_credentials
    secrets = {node: {"secret": one.secret} for node, one in found.items()}
    assert secrets == given["brokerCredentials"]
