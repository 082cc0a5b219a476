"""The node over real ROS 2: feedback, results, refusals, load, cancel, approval, shutdown."""

from __future__ import annotations

import json
import logging
import re
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rclpy
from action_msgs.msg import GoalStatusArray
from builtin_interfaces.msg import Time
from demandops.base.errors import NotReached
from demandops.base.quoting import is_visible
from demandops.base.settings import DEFAULT_ACTION_NAME
from demandops.cluster.health import Health
from demandops.serve.journal import Receipt
from demandops_interfaces.srv import GetBookkeeping
from demandops_ros.actions import DemandAdapter
from demandops_ros.demand_node import awaits_releases, rollout_answer
from demandops_ros.ros_process import RosLogHandler
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import qos_profile_action_status_default
from rosgraph_msgs.msg import Clock

from tests.kit.cli import process
from tests.kit.goals import link as connection
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import Person, git, hook, keygen, tip
from tests.kit.ros import Client, Serve, Served


def test_a_client_that_numbers_its_goals_ends_what_it_joined_if_ids_are_ignored(
    serve: Serve, client: Client
) -> None:
    served = serve(None, "--ros-args", "-p", "deployment_request_ids:=ignore")
    client.ready()
    joined, again = (client.call(connection(1) | {"id": f"goal {number}"}) for number in (1, 2))
    ended, repeated = (
        client.call(connection(1) | {"id": f"goal {number}", "shutdown": True}) for number in (3, 4)
    )
    assert [each.message.split(":")[0] for each in (joined, again, ended, repeated)] == [
        *("booked", "unchanged", "released", "not-held")
    ]
    assert served.bookkeeping()["connections"] == {}
    assert "goal 'goal 3': released" in served.log.read_text()
    assert "request 'ignored-id'" in git(served.state_repo, "log", "--format=%B", "main")


def test_a_hostile_id_stands_on_one_line_in_result_and_log(shared: Served, caller: Client) -> None:
    hostile = "a\n[ERROR] forged\x1b[2J\u202e" + "x" * 5000
    refused = caller.call({**connection(1002), "id": hostile})
    assert refused.status == "aborted"
    assert all(is_visible(line) for line in refused.message.split("\n"))
    caller.wait(lambda: "forged" in shared.log.read_text())
    told = [line for line in shared.log.read_text().splitlines() if "forged" in line]
    assert [line.count("goal 'a\\n[ERROR] forged") for line in told] == [1]
    assert is_visible(told[0]) and len(told[0]) < 5000


def test_a_level_that_is_not_reached_is_told_with_what_became_of_the_demand() -> None:
    health = Health("reconciled", "is still being removed", "Deployment ns/one")
    outcomes: tuple[Any, ...] = ("booked", "released")
    for outcome in outcomes:
        receipt = Receipt("o", "d", outcome, "a commit")
        assert rollout_answer(receipt, "reconciled", health) == (receipt, "reconciled")
        error, reached = rollout_answer(receipt, "healthy", health)
        assert isinstance(error, NotReached) and reached == "pushed"
        told = f"Deployment ns/one: is still being removed; the demand is {outcome} in a commit"
        assert str(error) == told
        assert DemandAdapter().result(error, "pushed").code == "not-healthy"
    # only a booked demand waits for its releases
    for answer, level, waits in (
        (Receipt("o", "d", "booked", "a commit"), "healthy", True),
        (Receipt("o", "d", "booked", "a commit"), "pushed", False),
        (Receipt("o", "d", "waiting", "a commit"), "healthy", False),
        (NotReached("healthy", "no"), "healthy", False),
    ):
        assert awaits_releases(answer, level) is waits


def test_a_debug_record_is_no_information(capfd: pytest.CaptureFixture[str]) -> None:
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("of_a_test", context=context)
    handler = RosLogHandler(node.get_logger())
    for level in (logging.DEBUG, logging.INFO, logging.ERROR):
        handler.handle(logging.LogRecord("x", level, "", 1, "of level %d", (level,), None))
    node.destroy_node()
    context.try_shutdown()
    printed, told = capfd.readouterr()
    assert [f"of level {level}" in printed + told for level in (10, 20, 40)] == [False, True, True]


@pytest.mark.parametrize("end", ["", "thread.close(); node.destroy_node()"])
def test_a_process_ends_with_0_while_its_executor_has_much_to_do(end: str) -> None:
    """Python aborts if a thread is still in ROS when the process ends.

    ``end`` is the last statement of the program; without it, the program leaves its node running.
    """
    program = (
        "import rclpy, time; from demandops_ros.ros_process import ExecutorThread\n"
        "rclpy.init(); node = rclpy.create_node('busy')\n"
        "node.create_timer(0.001, lambda: None); thread = ExecutorThread(node)\n"
        f"time.sleep(0.2); {end}"
    )
    assert process(sys.executable, "-c", program) == (0, "", "")


def test_a_goal_that_the_journal_cannot_keep_is_rejected_and_the_log_says_why(
    serve: Serve, client: Client
) -> None:
    served = serve()
    client.ready()
    assert client.call(connection(1)).status == "succeeded"
    resource.prlimit(served.process.pid, resource.RLIMIT_FSIZE, (1 << 19, 1 << 19))
    assert client.call({**connection(2), "id": "x" * 900_000}).accepted is False
    why = r"goal 'x+.* rejected: the journal \S+/outbox\.jsonl cannot be written: File too large; "
    assert re.search(why, served.log.read_text())
    assert client.call(connection(3)).status == "succeeded"


def test_a_result_is_kept_for_longer_than_the_ten_seconds_of_rclpy_but_its_goal_is_not(
    serve: Serve, client: Client
) -> None:
    serve(None, "--ros-args", "-p", "use_sim_time:=true")
    clock = client.node.create_publisher(Clock, "/clock", 1)
    heard: list[Any] = []
    client.node.create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)

    listed: list[GoalStatusArray] = []
    topic = f"{DEFAULT_ACTION_NAME}/_action/status"
    client.node.create_subscription(
        GoalStatusArray, topic, listed.append, qos_profile_action_status_default
    )
    told = 0

    def pass_time(seconds: int) -> None:
        """Publish a fast clock until the node reports a time at least ``seconds`` later."""
        nonlocal told
        until = told + seconds

        def is_later() -> bool:
            nonlocal told
            told += 1 if told > until else seconds
            clock.publish(Clock(clock=Time(sec=told)))
            return any(message.header.stamp.sec >= until for message in heard)

        client.wait(is_later)

    client.ready()
    pass_time(1000)
    first = client.call(connection(1))
    pass_time(12)
    again = first.handle.get_result_async()
    client.wait(again.done)
    assert again.result().result.message == first.message
    # each goal that ROS still lists would make all goals slower
    second = client.call(connection(2))
    newest = bytes(second.handle.goal_id.uuid)

    def lists_only_the_newest() -> bool:
        goals = listed[-1].status_list if listed else []
        return [bytes(goal.goal_info.goal_id.uuid) for goal in goals] == [newest]

    client.wait(lists_only_the_newest)


def test_a_hundred_goals_at_once_are_all_answered_and_none_is_lost(
    shared: Served, caller: Client
) -> None:
    before = tip(shared.state_repo)
    sent: list[Any] = []
    for number in range(2000, 2120):
        caller.wait(lambda: sum(not goal.answered for goal in sent) < 100)
        sent.append(caller.send(connection(number)))
    caller.wait(lambda: all(goal.answered for goal in sent))
    assert {goal.status for goal in sent} == {"succeeded"}
    booked = {f"c{number}" for number in range(2000, 2120)}
    assert shared.bookkeeping()["connections"].keys() >= booked
    assert git(shared.state_repo, "rev-list", "--count", f"{before}..main") == "120"
    assert shared.log.read_text().count("more than 10 goals of all clients are open") == 1


def test_a_goal_can_be_cancelled_until_it_is_committed_and_a_stopped_node_finishes_open_goals(
    serve: Serve, client: Client, bare: Path
) -> None:
    # every push waits until the folder has a file `go`
    hook(bare, "pre-receive", "for _ in $(seq 4800); do [ -e go ] && exit; sleep 0.05; done")
    served = serve(f"file://{bare}")
    client.ready()
    committed = client.send(connection(1))
    client.wait(lambda: any(text.startswith("committed") for text in committed.feedback))
    waiting, *others = (client.send(connection(number)) for number in range(2, 6))
    # the worker still pushes the first goal
    client.wait(lambda: all(goal.accepted is not None for goal in (waiting, *others)))
    assert client.cancel(waiting)
    assert not client.cancel(committed)
    served.process.send_signal(signal.SIGTERM)
    (bare / "go").touch()
    client.wait(lambda: all(goal.answered for goal in (committed, waiting, *others)))
    assert waiting.status == "cancelled"
    assert {goal.status for goal in (committed, *others)} == {"succeeded"}, served.log.read_text()
    assert served.process.wait(PATIENCE_S) == 0
    assert git(bare, "rev-list", "--count", "main") == "5"


def test_bookkeeping_is_answered_over_ros_by_one_thread(shared: Served, caller: Client) -> None:
    first = caller.call(connection(1003)).commit
    caller.call(connection(1004))
    service = caller.node.create_client(GetBookkeeping, "/demandops/get_bookkeeping")
    caller.wait(service.service_is_ready)

    def count() -> int:
        return len([*Path(f"/proc/{shared.process.pid}/task").iterdir()])

    threads = [count()]

    def ask(at: str, times: int = 1) -> list[Any]:
        calls = [service.call_async(GetBookkeeping.Request(at=at)) for _ in range(times)]
        caller.wait(lambda: threads.append(count()) or all(call.done() for call in calls))
        return [call.result() for call in calls]

    (now,), (then,), (unknown,) = ask(""), ask(first), ask("nonsense")
    assert now.ok and json.loads(now.bookkeeping_json) == shared.bookkeeping()
    assert then.commit == first
    assert {"c1003", "c1004"} & json.loads(then.bookkeeping_json)["connections"].keys() == {"c1003"}
    assert not unknown.ok
    assert unknown.message.startswith("'nonsense' is neither a commit of the state repo nor")
    answers = [answer for _ in range(10) for answer in ask(first, times=5)]
    assert max(threads) <= threads[0] + 2, (
        "one thread reads, and the thread before it may still be ending"
    )
    assert sum(answer.ok for answer in answers) >= 40
    refused = {answer.message for answer in answers if not answer.ok}
    assert refused <= {"4 calls are being answered; try again later"}


def test_action_name_state_repo_and_log_level_are_ros_parameters_and_commits_are_signed(
    serve: Serve, ros_domain: int, bare: Path, new_repo: Callable[[str], Path], tmp_path: Path
) -> None:
    key = keygen(tmp_path / "key")
    args = ["-p", "action_name:=/demands", "-p", f"state_repo:={bare}", "-p", "log_level:=error"]
    served = serve(new_repo("other.git"), "--signing-key", str(key), "--ros-args", *args)
    client = Client(ros_domain, "/demands")
    try:
        client.ready()
        assert client.call(connection(1)).status == "succeeded"
    finally:
        client.close()
    assert git(bare, "rev-list", "--count", "main") == "2"
    assert "\ngpgsig " in git(bare, "cat-file", "commit", "main")
    assert served.stop() == 0
    assert served.log.read_text() == ""


def test_a_goal_stays_open_until_a_person_has_decided(
    serve: Serve, client: Client, person: Person
) -> None:
    bare = person.bare
    person.policy(approval="required")
    served = serve(str(bare))
    client.ready()
    sent = [client.send(connection(number)) for number in (1, 2, 3, 4)]

    def branches() -> list[str]:
        lines = [line for one in sent for line in one.feedback]
        return [line.split()[2] for line in lines if line.startswith("awaiting approval: ")]

    client.wait(lambda: len(branches()) == 4)
    (approved, denied, gone, released), (yes, no, *_) = sent, branches()
    assert not any(one.answered for one in sent)
    assert client.cancel(gone)
    client.wait(lambda: gone.answered)
    assert gone.status == "cancelled"
    assert client.call(connection(4) | {"shutdown": True}).status == "succeeded"
    client.wait(lambda: released.answered)
    assert released.status == "aborted"
    assert released.message == "was released by a later request before it was approved"
    git(bare, "branch", "--delete", "--force", no)
    client.wait(lambda: denied.answered)
    assert denied.status == "aborted"
    told = f"turned-down: was turned down: {no} was deleted and not merged (commit "
    assert denied.message.startswith(told)
    commit = git(bare, "rev-parse", yes)
    merge = git(bare, "commit-tree", f"{yes}^{{tree}}", "-p", "main", "-p", yes, "-m", "Merge")
    git(bare, "update-ref", "refs/heads/main", merge)
    client.wait(lambda: approved.answered)
    assert (approved.status, approved.message) == ("succeeded", f"booked: {commit}")
    assert list(served.bookkeeping()["connections"]) == ["c1"]
    client.wait(lambda: git(bare, "for-each-ref", "refs/heads/demand") == "")
