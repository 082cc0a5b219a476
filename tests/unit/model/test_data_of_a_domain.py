"""The credentials of brokers keep the data of access domains apart."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml
from demandops.model.config.load import load

from tests.kit.config import configuration, skeleton
from tests.kit.memory import MemoryRepo
from tests.unit.model.test_config_mistakes import changed

DOMAINS, BROKERS = "policy/access-domains.yaml", "inventory/brokers.yaml"
PAGE = (Path(__file__).parents[3] / "docs" / "policy.md").read_text()


def secrets(files: dict[str, Any]) -> dict[str, list[tuple[str, list[str]]]]:
    """Return the secrets and keys that the clients of a connection between two domains get."""
    books = MemoryRepo(changed({"base": "two domains"} | files))
    link = {"id": "c", "source": "vehicle00", "target": "edge", "topics": [{"source": "/a"}]}
    books.send({"kind": "Demand", "demand": "d", "requesters": ["v"], "connections": [link]})
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


def test_the_example_of_the_documentation() -> None:
    (example,) = re.findall(r"\n\n(    ros: .*\n(?:    .*\n)*)", PAGE)
    config = load(configuration({DOMAINS: f"{skeleton()[DOMAINS]}{example}"}))
    given = yaml.safe_load(example)
    assert {node.ros.domain_id for node in config.nodes.values()} == {given["ros"]["domainId"]}
    found = config.domains["perception"].broker_credentials
    secrets = {node: {"secret": one.secret} for node, one in found.items()}
    assert secrets == given["brokerCredentials"]
