"""Our node keeps all rules; a server that answers every goal with success does not."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy
from application_manager_interfaces.action import DeploymentRequest
from demandops_interfaces.action import Demand
from demandops_interfaces.srv import GetBookkeeping
from demandops_ros.ros_process import ExecutorThread
from rclpy.action import ActionServer

from tests.conformance.__main__ import main
from tests.conformance.suite import OUTCOMES, RULES
from tests.kit.ros import reserved

ON_THE_WIRE = {
    "the feedback has the type of the action",
    "a result can be asked for again",
    "a goal that has ended cannot be cancelled",
}
"""The rules that every action server keeps that answers at all."""


def names_by_word(printed: str) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {"holds": set(), "differs": set(), "fails": set()}
    for line in printed.splitlines():
        word, _, name = line.partition(" ")
        if word in found:
            found[word].add(name.strip())
    return found


@contextmanager
def yes_server() -> Iterator[int]:
    """Serve both actions in a ROS domain of its own; answer every goal with success."""
    with reserved() as domain:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        node = rclpy.create_node("yes", context=context)

        def serve(action: Any, name: str) -> None:
            def succeed(handle: Any) -> Any:
                handle.succeed()
                return action.Result()

            ActionServer(node, action, name, succeed)

        serve(DeploymentRequest, "/yes/deployment_request")
        serve(Demand, "/yes/demand")
        node.create_service(GetBookkeeping, "/yes/bookkeeping", lambda _, answer: answer)
        thread = ExecutorThread(node)
        yield domain
        thread.close()
        node.destroy_node()
        context.try_shutdown()


def test_our_node_keeps_all_rules(capsys: pytest.CaptureFixture[str]) -> None:
    code = main([])
    printed = capsys.readouterr().out
    found = names_by_word(printed)
    assert (code, found["fails"], found["differs"]) == (0, set(), set()), printed
    assert len(found["holds"]) == sum(map(len, RULES.values())) + 7


def test_a_server_that_says_yes_to_everything_fails(capsys: pytest.CaptureFixture[str]) -> None:
    with yes_server() as domain:
        names = ["--server", "/yes/deployment_request", "--demand-server", "/yes/demand"]
        where = ["--bookkeeping", "/yes/bookkeeping", "--domain", str(domain)]
        assert main([*names, *where]) == 1
    found = names_by_word(capsys.readouterr().out)
    assert found["holds"] == ON_THE_WIRE
    assert found["differs"] == set()


def test_a_reference_may_differ_in_what_the_page_explains_and_in_nothing_else(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Without bookkeeping, only answers count, and the reference succeeds with every goal."""
    with yes_server() as domain:
        name = ["--server", "/yes/deployment_request", "--domain", str(domain)]
        assert main([*name, "--reference"]) == 0
        printed = capsys.readouterr().out
        assert main(name) == 1
    assert names_by_word(printed)["fails"] == set()
    refusing = {
        f"DeploymentRequest: {entry['rule']}"
        for entry in RULES["DeploymentRequest"]
        if any(step["is"] not in OUTCOMES for step in entry["steps"])
    }
    others = names_by_word(printed)["differs"] - refusing
    assert sorted(name.split(",")[0] for name in others) == [
        "46 random joins and shutdowns are counted",
        "each stage is told",
    ]
    assert refusing <= names_by_word(printed)["differs"]


def test_each_difference_is_a_row_of_the_page() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference.md").read_text()
    entries = (entry for rules in RULES.values() for entry in rules)
    named = {entry["reference"] for entry in entries if "reference" in entry}
    rows = {*re.findall(r"^\| `([\w-]+)` \|", page, re.MULTILINE)}
    assert named - rows == {"it succeeds and does nothing"}  # the page says so of every goal
