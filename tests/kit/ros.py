"""ROS in tests: a ROS domain, `demandops serve` as a process, and an action client."""

from __future__ import annotations

import fcntl
import io
import json
import os
import random
import signal
import socket
import subprocess
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from application_manager_interfaces.action import DeploymentRequest
from demandops.base.settings import DEFAULT_ACTION_NAME
from demandops.cli.main import run
from demandops_ros.actions import DEEP_QOS, DEEP_SERVICES, ask_the_node
from demandops_ros.messages import fill_message
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from unique_identifier_msgs.msg import UUID

from tests.kit.cli import PROGRAM
from tests.kit.limits import PATIENCE_S

STATUS = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_ABORTED: "aborted",
    GoalStatus.STATUS_CANCELED: "cancelled",
    GoalStatus.STATUS_UNKNOWN: "",  # a killed node had the goal, and the new one does not know it
}

_LAST = 100
"""The highest ROS domain to use; Linux may give a port of a higher domain to any socket."""


@contextmanager
def reserved() -> Iterator[int]:
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    domains = list(range(1, _LAST + 1))
    random.shuffle(domains)
    for domain in domains:
        path = Path(tempfile.gettempdir()) / f"ros-domain-{domain}.lock"
        with ExitStack() as stack:
            try:  # another user's file cannot be opened
                lock = stack.enter_context(path.open("w"))
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except (BlockingIOError, PermissionError):
                continue
            if _is_free(domain):
                yield domain
                return
    raise RuntimeError(f"all {_LAST} ROS domains are in use on this machine")


def _is_free(domain: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", 7400 + 250 * domain + 10))
        except OSError:
            return False
    return True


@dataclass
class Served:
    """A running `demandops serve`."""

    process: subprocess.Popen[str]
    state_repo: str
    log: Path
    environment: dict[str, str]
    domain: int

    def demandops(self, *args: str) -> str:
        with redirect_stdout(io.StringIO()) as printed:
            assert run([*args, "--state-repo", self.state_repo]) == 0
        return printed.getvalue()

    def bookkeeping(self) -> dict[str, Any]:
        data: dict[str, Any] = json.loads(self.demandops("bookkeeping", "--output", "json"))
        return data

    def wait_for(self, text: str) -> None:
        """Wait until the log contains ``text``; else fail with :meth:`last_words`."""
        end = time.monotonic() + PATIENCE_S
        while text not in self.log.read_text():
            is_over = self.process.poll() is not None or time.monotonic() > end
            if is_over and text not in self.log.read_text():
                raise AssertionError(f"the log does not say: {text}\n{self.last_words()}")
            time.sleep(0.05)

    def last_words(self) -> str:
        """Return how the process ended, and its log; abort a process that still runs."""
        code = self.process.poll()
        if code is None:
            self.process.send_signal(signal.SIGABRT)  # Python prints where each thread is
            self.process.wait(PATIENCE_S)
        return f"ended with {code}\n{self.log.read_text()}"

    def stop(self, number: signal.Signals = signal.SIGINT) -> int:
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)


Serve = Callable[..., Served]


class Servers:
    """Starts `demandops serve` and other commands in one ROS domain."""

    def __init__(self, folder: Path, domain: int, **environment: str) -> None:
        self._folder, self._domain = folder, domain
        self._environment = environment
        self._started: list[Served] = []

    def start(self, state_repo: str, *args: str) -> Served:
        return self.run(state_repo, "serve", "--state-repo", state_repo, *args)

    def run(self, state_repo: str, *words: str) -> Served:
        log = self._folder / f"node-{len(self._started)}.log"
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(self._domain),
            "ROS_LOG_DIR": str(self._folder / "ros-log"),
            "PYTHONFAULTHANDLER": "1",
            **self._environment,
        }
        with log.open("w") as sink:
            process = subprocess.Popen(
                [*PROGRAM, *words], env=environment, stdout=sink, stderr=sink, text=True
            )
        self._started.append(Served(process, state_repo, log, environment, self._domain))
        return self._started[-1]

    def kill(self) -> None:
        for served in self._started:
            print(served.last_words())  # pytest shows it if the test fails


@dataclass
class Sent:
    at: float
    handle: Any = None
    accepted: bool | None = None
    feedback: list[str] = field(default_factory=list)
    stages: dict[str, float] = field(default_factory=dict)
    """When each stage was reported; the result reports ``pushed`` if no feedback did."""
    status: str = ""
    message: str = ""
    cancel: bool | None = None

    @property
    def answered(self) -> bool:
        return bool(self.status) or self.accepted is False

    @property
    def commit(self) -> str:
        return self.message.splitlines()[0].split()[-1]


class Client:
    """An action client with its own executor, which spins only while the test waits."""

    def __init__(self, domain: int, action: str = DEFAULT_ACTION_NAME) -> None:
        self.action = action
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node("test_client", context=self._context)
        self.executor = SingleThreadedExecutor(context=self._context)
        self.executor.add_node(self.node)
        self._client = ActionClient(self.node, DeploymentRequest, action, **DEEP_SERVICES)
        # an action client forgets a goal's feedback once it has the result; a subscription does not
        self._sent: dict[bytes, Sent] = {}
        self.node.create_subscription(
            DeploymentRequest.Impl.FeedbackMessage,
            f"{action}/_action/feedback",
            self._on_feedback,
            DEEP_QOS,
        )

    def wait(self, condition: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "the condition did not hold in time"
            self.executor.spin_once(timeout_sec=0.05)

    def ready(self) -> None:
        self.wait(self._client.server_is_ready)
        self.ask(lambda: ask_the_node(self._client))

    def ask(self, call: Callable[[], Any]) -> None:
        """Call a service once a second until it answers; it may not know this client at first."""
        asked: list[Any] = []
        ask_at = 0.0

        def is_answered() -> bool:
            nonlocal ask_at
            if time.monotonic() > ask_at:
                ask_at = time.monotonic() + 1
                asked.append(call())
            return any(one.done() for one in asked)

        self.wait(is_answered)

    def send(self, goal: dict[str, Any]) -> Sent:
        """Send a goal; its answers arrive only while the client spins in :meth:`wait`."""
        sent, id = Sent(time.monotonic()), uuid.uuid4().bytes
        self._sent[id] = sent
        future = self._client.send_goal_async(
            fill_message(DeploymentRequest.Goal(), goal), goal_uuid=UUID(uuid=list(id))
        )
        future.add_done_callback(lambda done: self._on_response(sent, done.result()))
        return sent

    def _on_feedback(self, message: Any) -> None:
        sent = self._sent.get(bytes(message.goal_id.uuid))
        if sent is not None:
            text = message.feedback.message
            sent.feedback.append(text)
            sent.stages[text.split(maxsplit=1)[0]] = time.monotonic()

    def _on_response(self, sent: Sent, handle: Any) -> None:
        sent.handle, sent.accepted = handle, handle.accepted
        if handle.accepted:
            handle.get_result_async().add_done_callback(
                lambda done: self._on_result(sent, done.result())
            )

    @staticmethod
    def _on_result(sent: Sent, answer: Any) -> None:
        sent.message = answer.result.message
        sent.stages.setdefault("pushed", time.monotonic())
        sent.status = STATUS[answer.status]

    def cancel(self, sent: Sent) -> bool:
        future = sent.handle.cancel_goal_async()
        self.wait(future.done)
        return bool(future.result().goals_canceling)

    def call(self, sent: dict[str, Any]) -> Sent:
        under_way = self.send(sent)
        self.wait(lambda: under_way.answered)
        return under_way

    def close(self) -> None:
        self.executor.shutdown(timeout_sec=1)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)
