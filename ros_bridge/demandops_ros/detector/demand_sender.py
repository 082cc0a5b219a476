"""Sends the demands of events in separate threads, and sends a failed demand again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import inf

from application_manager_interfaces.action import DeploymentRequest
from demandops.base.quoting import one_line, quoted
from demandops.base.runtime import REAL
from demandops.detect.detection_state import Key
from demandops.detect.detector import Outcome, Sending, Want, WantedDemands
from demandops.detect.rule_demand import Goal

from demandops_ros.actions import DemandError, GoalSender
from demandops_ros.client import DemandClient
from demandops_ros.messages import fill_message

# How many goals are sent at the same time; the node publishes such goals together.
_THREADS = 8
_LONGEST_WAIT_S = 60.0

Log = Callable[[str, str], None]  # of a level, `info` or `warning`, and a text


class DemandSender:
    """Keeps the demands of the current events booked: sends, retries and renews them."""

    def __init__(
        self, action_name: str, demand_action_name: str, timeout_s: float, log: Log
    ) -> None:
        self._log = log
        self._wanted = WantedDemands()
        self._changed = REAL.condition()
        self._is_closed = False
        self._demands = DemandClient(
            action_name=demand_action_name,
            node_name="demandops_detector_client",
            timeout_s=timeout_s,
        )
        self._requests = GoalSender(
            DeploymentRequest, action_name, "demandops_detector_requests", timeout_s
        )
        self._threads = [
            REAL.keep_running(f"sender-{number}", self._run) for number in range(_THREADS)
        ]

    def close(self) -> None:
        """Stop sending; demands that are booked stay booked."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._demands.close()
        self._requests.close()

    def want(self, wants: Iterable[Want], booked: Mapping[Key, Goal] | None = None) -> None:
        """Record the demands that events need from now on, and send the goals for them.

        ``booked`` has the events whose demands were booked before the detector started, each with a
        goal that can end the demand.
        """
        with self._changed:
            for key, goal in (booked or {}).items():
                self._wanted.hold(key, goal)
            for want in wants:
                self._wanted.want(want)
            self._changed.notify_all()

    def summary(self) -> tuple[int, int, list[tuple[Key, str]]]:
        """Return how many events want or hold a demand, and how many of these have no answer yet.

        The third value has the events whose last goal failed, each with the reason.
        """
        with self._changed:
            return len(self._wanted), self._wanted.unanswered(), list(self._wanted.refusals())

    def _run(self) -> None:
        while (sending := self._take()) is not None:
            outcome = self._send(sending.goal)
            with self._changed:
                told = self._wanted.answered(sending, outcome, REAL.monotonic())
                self._changed.notify_all()
            rule, subjects = sending.key
            what = f"{sending.purpose} of {quoted(sending.goal.id)}"
            if subjects:
                what += f" for {', '.join(subjects)}"
            if told:
                self._log("warning", f"rule {rule}: {what} failed and will be tried again: {told}")
            elif not outcome.code and sending.purpose != "renew":
                self._log("info", f"rule {rule}: {what}: {outcome.message}")

    def _take(self) -> Sending | None:
        """Wait for a goal to send; return None once the sender is closed."""
        with self._changed:
            while not self._is_closed:
                now = REAL.monotonic()
                if sending := self._wanted.next(now):
                    return sending
                pause = self._wanted.next_at() - now
                self._changed.wait(None if pause == inf else max(0.0, min(pause, _LONGEST_WAIT_S)))
        return None

    def _send(self, goal: Goal) -> Outcome:
        try:
            if goal.action == "demand":
                answer = self._demands.send(goal.data)
                texts = (f"{answer.outcome} in {answer.commit}", *answer.warnings)
                return Outcome("", one_line("; warning: ".join(texts)), answer.lease_s)
            succeeded, result, _ = self._requests.send(
                fill_message(DeploymentRequest.Goal(), dict(goal.data))
            )
            lines = result.message.split("\n")
            text = one_line("; ".join(lines if succeeded else lines[:1]))
            # a failed request begins with the code, as this action has no field for it
            return Outcome("" if succeeded else text.partition(":")[0] or "aborted", text)
        except DemandError as error:
            return Outcome(error.code, one_line(str(error)))
        except Exception as error:  # a value that the message cannot carry, or a closed client
            return Outcome("fault", one_line(repr(error)))
