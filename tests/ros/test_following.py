"""The node follows its state repo and tells how it does: /diagnostics, webhook, feedback."""

from __future__ import annotations

import re
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from tests.kit.goals import link as connection
from tests.kit.repo import GitRepo, read
from tests.kit.repo import init as new_state_repo
from tests.kit.ros import Client, Serve

NODES = "inventory/nodes.yaml"
STATE, CONFIGURATION = "demandops: state repo", "demandops: configuration"


class Heard:
    """The newest of each status on /diagnostics."""

    def __init__(self, client: Client) -> None:
        self.statuses: dict[str, Any] = {}
        client.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)

    def _hear(self, message: Any) -> None:
        self.statuses |= {status.name: status for status in message.status}

    def is_at(self, name: str, level: bytes) -> bool:
        return name in self.statuses and self.statuses[name].level == level

    def values(self, name: str) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.statuses[name].values}


def test_diagnostics_tell_what_is_not_valid_and_that_the_remote_is_away(
    serve: Serve, client: Client, tmp_path: Path
) -> None:
    bare = new_state_repo(tmp_path / "state.git")
    heard = Heard(client)
    url = f"file://{bare}"
    served = serve(url, "--fetch-interval", "0.2")
    client.ready()
    client.wait(lambda: heard.is_at(STATE, DiagnosticStatus.OK))
    assert heard.is_at(CONFIGURATION, DiagnosticStatus.OK)
    assert client.call(connection(1)).status == "succeeded"
    client.wait(lambda: heard.values(STATE)["last push"] != "never")
    assert heard.statuses[STATE].hardware_id == url

    nodes = read(bare, NODES)
    GitRepo(bare).commit({NODES: nodes.replace("cluster: c-its", "cluster: c-itz", 1)})
    client.wait(lambda: heard.is_at(CONFIGURATION, DiagnosticStatus.WARN))
    assert heard.values(CONFIGURATION)["problem 1"].startswith(f"{NODES}: nodes[")
    GitRepo(bare).commit({NODES: nodes})
    client.wait(lambda: heard.is_at(CONFIGURATION, DiagnosticStatus.OK))

    away = bare.rename(tmp_path / "away.git")
    client.wait(lambda: heard.is_at(STATE, DiagnosticStatus.WARN))
    assert heard.values(STATE)["reachable"] == "false"
    waiting = client.send(connection(2))
    taken_back = client.send(connection(3))
    client.wait(lambda: bool(waiting.feedback))
    assert waiting.feedback[0].startswith(f"waiting: {url} cannot be fetched: ")
    client.wait(lambda: heard.is_at(STATE, DiagnosticStatus.ERROR))
    assert int(heard.values(STATE)["demands in the outbox"]) >= 1
    client.wait(lambda: taken_back.accepted is not None)
    assert client.cancel(taken_back)
    client.wait(lambda: taken_back.answered)
    assert taken_back.status == "cancelled"
    away.rename(bare)
    client.wait(lambda: waiting.answered)
    assert waiting.status == "succeeded"
    client.wait(lambda: heard.is_at(STATE, DiagnosticStatus.OK))
    assert served.stop() == 0
    log = served.log.read_text()
    assert log.count("trying again until it is back") == 1
    assert log.count("is back after") == 1


def test_a_push_that_the_webhook_hears_of_is_followed_at_once(
    serve: Serve, client: Client, tmp_path: Path
) -> None:
    """With the interval off, nothing else could tell."""
    bare = new_state_repo(tmp_path / "state.git")
    args = ["--webhook", "127.0.0.1:0", "--ros-args", "-p", "fetch_interval:=0"]
    served = serve(f"file://{bare}", *args)
    client.ready()
    assert client.call(connection(1)).status == "succeeded"
    brokers = read(bare, "inventory/brokers.yaml")
    GitRepo(bare).commit({"inventory/brokers.yaml": brokers.replace("broker-edge", "broker-moved")})
    client.wait(lambda: "listening for pushes at " in served.log.read_text())
    found = re.search(
        r"listening for pushes at (http://127.0.0.1:[0-9]+/push)", served.log.read_text()
    )
    assert found is not None
    with urllib.request.urlopen(found[1], data=b"{}", timeout=10) as answer:  # noqa: S310
        assert answer.status == 202
    command = ["git", "-C", str(bare), "log", "-1", "--format=%an %cn", "main"]
    client.wait(
        lambda: (
            subprocess.run(command, capture_output=True, text=True, check=True).stdout
            == "A person DemandOps generator\n"
        )
    )
    assert served.stop() == 0


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["--fetch-interval", "often"], 2, "fetch interval: 'often' is not a duration; write one"),
        (["--ros-args", "-p", "fetch_interval:=-3"], 2, "fetch interval: '-3' is not a duration"),
        (["--webhook", "0.0.0.0:0"], 1, "error: --webhook: '0.0.0.0:0' can be reached from other"),
        (
            ["--webhook", "127.0.0.1:0", "--webhook-secret-file", "/nowhere/secret"],
            1,
            "error: /nowhere/secret: cannot be read: No such file",
        ),
    ],
)
def test_what_cannot_be_served_is_told_at_the_start(
    serve: Serve, args: list[str], code: int, message: str
) -> None:
    served = serve(None, *args)
    assert served.process.wait(30) == code
    assert message in served.log.read_text()
