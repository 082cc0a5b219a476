"""The node follows its state repo, by polls or a webhook, and reports how it is doing."""

from __future__ import annotations

import re
import urllib.request
from pathlib import Path
from typing import Any

from application_manager_interfaces.action import DeploymentRequest
from demandops.base.settings import DEFAULT_ACTION_NAME, DEFAULT_DEMAND_ACTION_NAME
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.action import ActionServer

from tests.kit.goals import link as connection
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import GitRepo, git, read
from tests.kit.ros import Client, Serve, Served

NODES = "inventory/nodes.yaml"
STATE, CONFIGURATION = "demandops: state repo", "demandops: configuration"
ACTIONS = "demandops: actions"


class Diagnostics:
    """Receives /diagnostics and keeps the newest status of each name."""

    def __init__(self, client: Client) -> None:
        self.statuses: dict[str, Any] = {}
        client.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)

    def _hear(self, message: Any) -> None:
        self.statuses |= {status.name: status for status in message.status}

    def is_at(self, name: str, level: bytes) -> bool:
        return name in self.statuses and self.statuses[name].level == level

    def values(self, name: str) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.statuses[name].values}


def test_diagnostics_report_invalid_configuration_and_an_unreachable_remote(
    serve: Serve, client: Client, bare: Path, tmp_path: Path
) -> None:
    heard = Diagnostics(client)
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
    withdrawn = client.send(connection(3))
    client.wait(lambda: bool(waiting.feedback))
    assert waiting.feedback[0].startswith(f"waiting: {url} cannot be fetched: ")
    client.wait(lambda: heard.is_at(STATE, DiagnosticStatus.ERROR))
    assert int(heard.values(STATE)["unpublished demands"]) >= 1
    client.wait(lambda: withdrawn.accepted is not None)
    assert client.cancel(withdrawn)
    client.wait(lambda: withdrawn.answered)
    assert withdrawn.status == "cancelled"
    away.rename(bare)
    client.wait(lambda: waiting.answered)
    assert waiting.status == "succeeded"
    client.wait(lambda: heard.is_at(STATE, DiagnosticStatus.OK))
    assert served.stop() == 0
    log = served.log.read_text()
    assert log.count("trying again until the state repo is back") == 1
    assert log.count("is back after") == 1


def test_another_node_that_serves_the_same_action_is_noticed(
    shared: Served, caller: Client
) -> None:
    def told() -> list[str]:
        log = shared.log.read_text().splitlines()
        return [line.partition("]: ")[2] for line in log if f"serves {DEFAULT_ACTION_NAME}" in line]

    heard = Diagnostics(caller)
    caller.wait(lambda: heard.is_at(ACTIONS, DiagnosticStatus.OK))
    server = ActionServer(caller.node, DeploymentRequest, DEFAULT_ACTION_NAME, lambda goal: None)
    caller.wait(lambda: heard.is_at(ACTIONS, DiagnosticStatus.WARN))
    assert heard.values(ACTIONS) == {
        DEFAULT_ACTION_NAME: "/test_client",
        DEFAULT_DEMAND_ACTION_NAME: "",
    }
    server.destroy()
    caller.wait(lambda: heard.is_at(ACTIONS, DiagnosticStatus.OK))
    caller.wait(lambda: len(told()) == 2)
    another, gone = told()
    assert another.startswith(f"/test_client serves {DEFAULT_ACTION_NAME} too, so a client may get")
    assert gone == f"no other node serves {DEFAULT_ACTION_NAME} any more"


def test_pushes_are_followed_by_a_webhook_and_the_page_shows_what_the_node_does(
    serve: Serve, client: Client, bare: Path
) -> None:
    """Nothing polls the remote, so a push is known by the webhook alone, a commit by the node."""
    args = ["--webhook", "127.0.0.1:0", "--web", "127.0.0.1:0"]
    served = serve(f"file://{bare}", *args, "--ros-args", "-p", "fetch_interval:=0")
    client.ready()

    def opened(after: str, path: str = "", data: bytes | None = None) -> str:
        """Return the answer of the address that the log names after a text."""
        served.wait_for(after)
        found = re.search(rf"{after}(http://127.0.0.1:[0-9]+/\w*)", served.log.read_text())
        assert found is not None
        with urllib.request.urlopen(found[1] + path, data, PATIENCE_S) as answer:  # noqa: S310
            return f"{answer.status} {answer.read().decode()}"

    page = "the page of the state repo is at "
    assert "Nothing is demanded" in opened(page)
    assert client.call(connection(1)).status == "succeeded"
    client.wait(lambda: "1 in all" in opened(page, "connections"))
    brokers = read(bare, "inventory/brokers.yaml")
    GitRepo(bare).commit({"inventory/brokers.yaml": brokers.replace("broker-edge", "broker-moved")})
    assert opened("listening for pushes at ", data=b"{}").startswith("202 ")
    follow = "A person DemandOps generator"
    client.wait(lambda: git(bare, "log", "-1", "--format=%an %cn", "main") == follow)
    assert served.stop() == 0
