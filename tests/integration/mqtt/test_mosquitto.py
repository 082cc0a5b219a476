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

from tests.integration.mqtt.conftest import PASSWORD, USER, Broker, Client, Pod
from tests.kit.connections import routes
from tests.kit.memory import MemoryRepo

DEMAND: dict[str, Any] = {
    "connections": [
        {
            "id": "vehicle00/edge",
            "source": "vehicle00",
            "target": "edge",
            "topics": {
                "/position": {"target": "/fleet/position", "qos": 1, "retained": True},
                "/speed": "/fleet/speed",
                "/warnings": {"target": "/fleet/warnings", "reverse": True, "qos": 2},
            },
        }
    ]
}

Ends = dict[str, Pod]


@pytest.fixture(scope="module")
def manifests(broker: Broker) -> dict[str, str]:
    """Return the manifests of both ends of a connection, by side."""
    repo = MemoryRepo({"inventory/brokers.yaml": broker.inventory()})
    made = repo.decide(routes(DEMAND))
    return {
        side: text
        for path, text in made.files.items()
        for side in ("source", "target")
        if text and f"-{side}-" in path and path.startswith("clusters/")
    }


@pytest.fixture(scope="module")
def pods(
    manifests: dict[str, str], broker: Broker, tmp_path_factory: pytest.TempPathFactory
) -> Ends:
    """Return the pods of both ends, whose init containers have run."""
    secrets = {
        "broker-ca": {"ca.crt": broker.authority.read_text()},
        "broker-login": {"username": USER + "\n", "password": PASSWORD},
    }
    folder = tmp_path_factory.mktemp("pods")
    return {side: Pod(text, secrets, folder / side) for side, text in manifests.items()}


@pytest.fixture
def connect(pods: Ends) -> Iterator[Callable[..., Client]]:
    """Return a function that connects the client of one end, with some parameters replaced."""
    opened: list[Client] = []

    def client(side: str, **changed: Any) -> Client:
        opened.append(Client(pods[side].parameters | changed))
        return opened[-1]

    yield client
    for each in opened:
        each.close()


def test_a_message_passes_both_ways_as_the_parameters_say(connect: Callable[..., Client]) -> None:
    source, target = connect("source"), connect("target")
    assert source.reason == target.reason == "Success"
    source.ready()
    target.ready()

    source.publish("/speed", b"30")
    source.publish("/position", b"here")
    target.publish("/fleet/warnings", b"ice")

    target.wait(lambda: len(target.arrived) == 2)
    source.wait(lambda: source.arrived)
    ros = {
        topic: target.parameters[f"bridge.mqtt2ros.{topic}.ros_topic"]
        for topic, *_ in target.arrived
    }
    assert sorted((ros[topic], payload, qos) for topic, payload, qos, _ in target.arrived) == [
        ("/fleet/position", b"here", 1),
        ("/fleet/speed", b"30", 0),
    ]
    ((topic, payload, qos, _),) = source.arrived
    assert source.parameters[f"bridge.mqtt2ros.{topic}.ros_topic"] == "/warnings"
    assert (payload, qos) == (b"ice", 2)


def test_a_late_client_gets_the_retained_message_only(
    connect: Callable[..., Client],
) -> None:
    source = connect("source")
    source.publish("/speed", b"31")
    source.publish("/position", b"there")

    late = connect("target")
    late.ready()
    late.wait(lambda: late.arrived)

    ((topic, payload, _, retained),) = late.arrived
    assert late.parameters[f"bridge.mqtt2ros.{topic}.ros_topic"] == "/fleet/position"
    assert (payload, retained) == (b"there", True)


def test_the_password_is_what_lets_in(connect: Callable[..., Client]) -> None:
    refused = connect("source", **{"broker.pass": "wrong"})
    assert refused.reason == "Not authorized"


def test_a_broker_of_another_authority_is_not_trusted(
    connect: Callable[..., Client], tmp_path: Path
) -> None:
    from tests.e2e.rig import pki

    other = pki.make(tmp_path / "other").authority
    with pytest.raises(ssl.SSLCertVerificationError):
        connect("source", **{"broker.tls.ca_certificate": str(other)})


def test_neither_name_nor_password_is_in_what_git_holds(manifests: dict[str, str]) -> None:
    assert len(manifests) == 2
    for text in manifests.values():
        assert "12345" not in text
        assert "fleet 007" not in text


def test_what_the_init_container_writes_is_for_the_pods_user_alone(pods: Ends) -> None:
    assert pods
    for pod in pods.values():
        mode = (pod.folder / "credentials" / "params.yaml").stat().st_mode
        assert stat.S_IMODE(mode) == 0o600
