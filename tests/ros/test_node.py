"""The node over real ROS 2: feedback, results, refusals, load, cancel, shutdown."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from demandops_interfaces.srv import GetBookkeeping

from examples.experiment import paper
from tests.kit.goals import experiment
from tests.kit.goals import link as connection
from tests.kit.repo import git
from tests.kit.repo import init as new_state_repo
from tests.kit.ros import Client, Serve, Served


def slow_remote(bare: Path, seconds: float) -> str:
    """Make pushes to a repository take a while, and return its URL."""
    hook = bare / "hooks" / "pre-receive"
    hook.parent.mkdir(exist_ok=True)
    hook.write_text(f"#!/bin/sh\nsleep {seconds}\n")
    hook.chmod(0o755)
    return f"file://{bare}"


def test_the_eight_steps_of_the_paper_give_its_bookkeeping(serve: Serve, client: Client) -> None:
    served = serve()
    client.ready()
    for step in range(1, 9):
        answer = client.call(experiment(step))
        assert answer.status == "succeeded", answer.message
        word, commit = answer.message.split("\n")[0].split(": ")
        assert word == ("booked" if step < 5 else "released")
        told = ["admitted", "booked", f"committed {commit}", f"pushed {commit}"]
        if step == 1:  # the node may not have found the client's subscription to feedback yet
            client.wait(lambda: bool(client.call(experiment(1)).feedback))
        else:
            client.wait(lambda: len(answer.feedback) == 4)  # noqa: B023 - it may come last
        assert answer.feedback == told[4 - len(answer.feedback) :]
        assert git(served.state_repo, "rev-parse", "main") == commit
        books = served.bookkeeping()
        assert paper.observed(books) == paper.expected(step)
        assert books["commit"] == commit
    assert git(served.state_repo, "rev-list", "--count", "main") == "9"


def test_a_goal_that_cannot_be_honoured_is_aborted_with_code_field_and_remedy(
    serve: Serve, client: Client
) -> None:
    served = serve()
    client.ready()
    refused = client.call(connection(1, target_node_id="egde"))
    assert refused.accepted and refused.status == "aborted"
    assert refused.message == (
        "unknown-node: connections[0].target_node_id: 'egde' is not in inventory/nodes.yaml; "
        "did you mean 'edge'?"
    )
    assert refused.feedback == []
    assert git(served.state_repo, "rev-list", "--count", "main") == "1"
    assert client.call(connection(1)).status == "succeeded"


def test_a_goal_sent_again_succeeds_without_a_commit(serve: Serve, client: Client) -> None:
    served = serve()
    client.ready()
    first, again = client.call(connection(1)), client.call(connection(1))
    tip = git(served.state_repo, "rev-parse", "main")
    assert first.message == f"booked: {tip}"
    assert (again.status, again.message) == ("succeeded", f"unchanged: {tip}")


def test_two_hundred_goals_at_once_are_all_answered_and_none_is_lost(
    serve: Serve, client: Client
) -> None:
    served = serve()
    client.ready()
    sent: list[Any] = []
    for number in range(200):
        client.wait(lambda: sum(not goal.answered for goal in sent) < 100)
        sent.append(client.send(connection(number)))
    client.wait(lambda: all(goal.answered for goal in sent))
    assert {goal.status for goal in sent} == {"succeeded"}
    assert len(served.bookkeeping()["connections"]) == 200
    assert git(served.state_repo, "rev-list", "--count", "main") == "201"


def test_a_goal_can_be_cancelled_until_it_is_committed_and_not_after(
    serve: Serve, client: Client, tmp_path: Path
) -> None:
    bare = new_state_repo(tmp_path / "slow.git")
    served = serve(slow_remote(bare, 2))
    client.ready()
    committed = client.send(connection(1))
    client.wait(lambda: any(text.startswith("committed") for text in committed.feedback))
    waiting = client.send(connection(2))  # the worker is busy pushing the first
    client.wait(lambda: waiting.accepted is not None)
    assert client.cancel(waiting)
    assert not client.cancel(committed)
    client.wait(lambda: waiting.answered and committed.answered)
    assert (waiting.status, committed.status) == ("cancelled", "succeeded")
    assert list(served.bookkeeping()["connections"]) == ["c1"]
    assert git(str(bare), "rev-list", "--count", "main") == "2"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_told_to_stop_it_finishes_what_is_in_hand(
    serve: Serve, client: Client, tmp_path: Path, number: signal.Signals
) -> None:
    bare = new_state_repo(tmp_path / "slow.git")
    served = serve(slow_remote(bare, 1))
    client.ready()
    goals = [client.send(connection(i)) for i in range(5)]
    client.wait(lambda: all(goal.accepted is not None for goal in goals))
    client.wait(lambda: any("committed" in text for goal in goals for text in goal.feedback))
    served.process.send_signal(number)
    client.wait(lambda: all(goal.answered for goal in goals))
    assert {goal.status for goal in goals} == {"succeeded"}, served.log.read_text()
    assert served.process.wait(30) == 0
    assert git(str(bare), "rev-list", "--count", "main") == "6"


def test_a_restart_takes_up_what_was_acknowledged_nowhere(
    serve: Serve, client: Client, tmp_path: Path
) -> None:
    bare = new_state_repo(tmp_path / "slow.git")
    served = serve(slow_remote(bare, 30))
    client.ready()
    goal = client.send(connection(1))
    client.wait(lambda: any("committed" in text for text in goal.feedback))
    served.process.kill()
    served.process.wait(10)
    (bare / "hooks" / "pre-receive").unlink()
    again = serve(served.state_repo)
    client.wait(lambda: "c1" in again.bookkeeping()["connections"])
    assert git(str(bare), "rev-list", "--count", "main") == "2"


def test_bookkeeping_is_answered_over_ros(serve: Serve, client: Client) -> None:
    served = serve()
    client.ready()
    first = client.call(connection(1)).message.removeprefix("booked: ")
    client.call(connection(2))
    service = client.node.create_client(GetBookkeeping, "/demandops/get_bookkeeping")
    client.wait(service.service_is_ready)

    def ask(at: str) -> Any:
        future = service.call_async(GetBookkeeping.Request(at=at))
        client.wait(future.done)
        return future.result()

    now = ask("")
    assert now.ok and json.loads(now.bookkeeping_json) == served.bookkeeping()
    then = ask(first)
    assert then.commit == first
    assert list(json.loads(then.bookkeeping_json)["connections"]) == ["c1"]
    unknown = ask("nonsense")
    assert not unknown.ok
    assert unknown.message == (
        "'nonsense' is neither a commit of the state repo nor a time; `demandops log` lists the "
        "commits, a time is written like 2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h"
    )


def test_action_name_state_repo_and_log_level_are_ros_parameters(
    serve: Serve, ros_domain: int, tmp_path: Path
) -> None:
    other = new_state_repo(tmp_path / "other.git")
    args = ["-p", "action_name:=/demands", "-p", f"state_repo:={other}", "-p", "log_level:=error"]
    served = serve(None, "--ros-args", *args)
    client = Client(ros_domain, "/demands")
    try:
        client.ready()
        assert client.call(connection(1)).status == "succeeded"
    finally:
        client.close()
    assert git(str(other), "rev-list", "--count", "main") == "2"
    assert served.stop() == 0
    assert served.log.read_text() == ""


def _refused_start(serve: Serve, repo: str, *args: str) -> tuple[int, str]:
    served: Served = serve(repo, *args)
    return served.process.wait(30), served.log.read_text()


def test_a_state_repo_that_is_none_is_told_with_the_remedy(serve: Serve, tmp_path: Path) -> None:
    code, text = _refused_start(serve, str(tmp_path / "nowhere"))
    assert code == 1
    assert text == (
        f"error: {tmp_path}/nowhere does not exist; make a state repo with "
        f"`demandops init {tmp_path}/nowhere --bare`\n"
    )


def test_a_wrong_log_level_is_a_usage_error(serve: Serve, tmp_path: Path) -> None:
    args = ("--ros-args", "-p", "log_level:=loud")
    code, text = _refused_start(serve, str(tmp_path), *args)
    assert code == 2
    assert "parameter log_level is 'loud'; it takes debug, info, warn, error, fatal" in text


def test_two_nodes_on_one_state_repo_lose_nothing(serve: Serve, ros_domain: int) -> None:
    first = serve(None, "--ros-args", "-p", "action_name:=/one")
    one, two = Client(ros_domain, "/one"), Client(ros_domain, "/two")
    try:
        one.ready()
        serve(first.state_repo, "--ros-args", "-p", "action_name:=/two", "-r", "__node:=second")
        two.ready()
        goals = [(one, one.send(connection(i))) for i in range(0, 40, 2)]
        goals += [(two, two.send(connection(i))) for i in range(1, 40, 2)]
        end = time.monotonic() + 60
        while not all(goal.answered for _, goal in goals) and time.monotonic() < end:
            one.wait(lambda: True)
            for client, _ in goals[::20]:
                client._executor.spin_once(timeout_sec=0.01)
        assert {goal.status for _, goal in goals} == {"succeeded"}
    finally:
        one.close()
        two.close()
    assert len(first.bookkeeping()["connections"]) == 40
    assert git(first.state_repo, "rev-list", "--count", "main") == "41"
