"""ROS in tests: a domain of one's own, `demandops serve` as a process, and an action client."""

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
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from application_manager_interfaces.action import DeploymentRequest
from demandops.cli.main import run
from demandops_ros.messages import fill_message
from demandops_ros.node import DEEP_QOS
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from unique_identifier_msgs.msg import UUID

ACTION = "/event_detector_operator_plugin/operator_plugin/deployment_request"
DEADLINE_S = 60.0
STATUS = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_ABORTED: "aborted",
    GoalStatus.STATUS_CANCELED: "cancelled",
}

_LAST = 100
"""Above it the ports of a domain are among those that Linux gives to any socket."""


@contextmanager
def reserved() -> Iterator[int]:
    """Hold a domain that nobody on this machine uses, and talk on this machine only."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    domains = list(range(1, _LAST + 1))
    random.shuffle(domains)
    for domain in domains:
        path = Path(tempfile.gettempdir()) / f"ros-domain-{domain}.lock"
        with path.open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            if _is_free(domain):
                yield domain
                return
    raise RuntimeError(f"all {_LAST} ROS domains are in use on this machine")


def _is_free(domain: int) -> bool:
    """Tell whether nobody listens where the domain's first participant would."""
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

    def demandops(self, *args: str) -> str:
        with redirect_stdout(io.StringIO()) as printed:
            assert run([*args, "--state-repo", self.state_repo]) == 0
        return printed.getvalue()

    def bookkeeping(self) -> dict[str, Any]:
        data: dict[str, Any] = json.loads(self.demandops("bookkeeping", "--output", "json"))
        return data

    def stop(self, number: signal.Signals = signal.SIGINT) -> int:
        self.process.send_signal(number)
        return self.process.wait(30)


Serve = Callable[..., Served]


@dataclass
class Sent:
    """A goal under way, and what was heard of it."""

    handle: Any = None
    accepted: bool | None = None
    feedback: list[str] = field(default_factory=list)
    status: str = ""
    message: str = ""
    cancel: bool | None = None

    @property
    def answered(self) -> bool:
        return bool(self.status) or self.accepted is False


class Client:
    """An action client with its own executor; a test drives it."""

    def __init__(self, domain: int, action: str = ACTION, deep: bool = True) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node("test_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        qos = (
            {f"{service}_service_qos_profile": DEEP_QOS for service in ("goal", "result", "cancel")}
            if deep
            else {}
        )
        self._client = ActionClient(self.node, DeploymentRequest, action, **qos)
        # an action client forgets a goal's feedback once it has the result; a subscription does not
        self._sent: dict[bytes, Sent] = {}
        self.node.create_subscription(
            DeploymentRequest.Impl.FeedbackMessage,
            f"{action}/_action/feedback",
            self._hear,
            DEEP_QOS,
        )

    def wait(self, condition: Callable[[], bool], seconds: float = DEADLINE_S) -> None:
        """Spin until something holds; fail the test where it does not in time."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "the client waited in vain"
            self._executor.spin_once(timeout_sec=0.05)

    def ready(self) -> None:
        self.wait(self._client.server_is_ready)

    def send(self, goal: dict[str, Any]) -> Sent:
        """Send a goal; what is heard of it arrives while the client waits for something."""
        sent, id = Sent(), uuid.uuid4().bytes
        self._sent[id] = sent
        future = self._client.send_goal_async(
            fill_message(DeploymentRequest.Goal(), goal), goal_uuid=UUID(uuid=list(id))
        )
        future.add_done_callback(lambda done: self._on_response(sent, done.result()))
        return sent

    def _hear(self, told: Any) -> None:
        sent = self._sent.get(bytes(told.goal_id.uuid))
        if sent is not None:
            sent.feedback.append(told.feedback.message)

    def _on_response(self, sent: Sent, handle: Any) -> None:
        sent.handle, sent.accepted = handle, handle.accepted
        if handle.accepted:
            handle.get_result_async().add_done_callback(
                lambda done: self._on_result(sent, done.result())
            )

    @staticmethod
    def _on_result(sent: Sent, answer: Any) -> None:
        sent.message = answer.result.message
        sent.status = STATUS[answer.status]

    def cancel(self, sent: Sent) -> bool:
        """Ask to cancel; tell whether the server agreed."""
        future = sent.handle.cancel_goal_async()
        self.wait(future.done)
        return bool(future.result().goals_canceling)

    def call(self, sent: dict[str, Any]) -> Sent:
        """Send a goal and wait for its answer."""
        under_way = self.send(sent)
        self.wait(lambda: under_way.answered)
        return under_way

    def close(self) -> None:
        self._executor.shutdown(timeout_sec=1)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)
