"""A real broker with TLS and a password carries messages between both ends of a connection.

The clients use only the rendered manifests: the tests run the init containers, and the real rcl
reads the parameters. paho stands in for mqtt_client.
"""

from __future__ import annotations

import ssl
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.rig import pki
from tests.integration.mqtt.conftest import PASSWORD, USER, Broker, Client, Pod
from tests.kit.connections import demand, routes
from tests.kit.memory import MemoryRepo
from tests.kit.rig import wait_until

TOPICS = {
    "/position": {"target": "/fleet/position", "qos": 1, "retained": True},
    "/speed": "/fleet/speed",
    "/warnings": {"target": "/fleet/warnings", "reverse": True, "qos": 2},
}

Ends = dict[str, Pod]


@pytest.fixture(scope="module")
def pods(broker: Broker, tmp_path_factory: pytest.TempPathFactory) -> Ends:
    made = MemoryRepo({"inventory/brokers.yaml": broker.inventory()}).decide(
        routes(demand("mqtt", TOPICS, id="vehicle00/edge"))
    )
    manifests = {
        side: text
        for path, text in made.files.items()
        for side in ("source", "target")
        if text and f"-{side}-" in path and path.startswith("clusters/")
    }
    secrets = {
        "broker-ca": {"ca.crt": broker.authority.read_text()},
        "broker-login": {"username": USER + "\n", "password": PASSWORD},
    }
    folder = tmp_path_factory.mktemp("pods")
    return {side: Pod(text, secrets, folder / side) for side, text in manifests.items()}


@pytest.fixture
def connect(pods: Ends) -> Iterator[Callable[..., Client]]:
    opened: list[Client] = []

    def client(side: str, **changed: Any) -> Client:
        opened.append(Client(pods[side].parameters | changed))
        return opened[-1]

    yield client
    for each in opened:
        each.close()


def test_a_message_passes_both_ways_and_a_late_client_gets_the_retained_one_only(
    connect: Callable[..., Client],
) -> None:
    source, target = connect("source"), connect("target")
    assert source.reason == target.reason == "Success"
    source.ready()
    target.ready()
    source.publish("/speed", b"30")
    source.publish("/position", b"here")
    target.publish("/fleet/warnings", b"ice")
    wait_until(lambda: len(target.arrived) == 2 and source.arrived, "all has arrived")
    position = ("/fleet/position", b"here", 1, False)
    assert target.named() == [position, ("/fleet/speed", b"30", 0, False)]
    assert source.named() == [("/warnings", b"ice", 2, False)]
    late = connect("target", **{"client.id": "late"})
    late.ready()
    wait_until(lambda: late.arrived, "the retained message arrives")
    assert late.named() == [("/fleet/position", b"here", 1, True)]


def test_only_the_password_lets_in_and_only_our_authority_is_trusted(
    connect: Callable[..., Client], tmp_path: Path, pods: Ends
) -> None:
    assert connect("source", **{"broker.pass": "wrong"}).reason == "Not authorized"
    other = pki.make(tmp_path / "other").authority
    with pytest.raises(ssl.SSLCertVerificationError):
        connect("source", **{"broker.tls.ca_certificate": str(other)})
    for pod in pods.values():  # what the init container writes is for the pod's user alone
        mode = (pod.folder / "credentials" / "params.yaml").stat().st_mode
        assert stat.S_IMODE(mode) == 0o600
