"""The detector's status on ``/diagnostics``: its rules, its data and its demands."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from demandops.base.errors import InvalidInput
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL
from demandops.base.strict_yaml import read_input
from demandops.detect.detection_state import Observation
from demandops.detect.detector import Detector, booked_events
from demandops.detect.rule_file import RuleFile, read
from demandops_interfaces.msg import Bookkeeping
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile

from demandops_ros import ros_process
from demandops_ros.detector import detect_command
from demandops_ros.detector.demand_sender import DemandSender
from demandops_ros.detector.source_subscriptions import SourceSubscriptions, faults_of_types
from demandops_ros.publications import status

_MOST_REFUSALS = 20


class DetectorDiagnostics:
    def __init__(self, node: Node, rules: str) -> None:
        self._node, self._rules = node, rules
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def publish(
        self,
        problems: Sequence[str],
        detector: Detector,
        topics: SourceSubscriptions,
        sender: DemandSender,
        is_started: bool,
    ) -> None:
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        statuses = []

        level, text = DiagnosticStatus.OK, "valid"
        if problems:
            level = DiagnosticStatus.WARN
            text = "the file cannot be read or is invalid; the last valid rules are in effect"
        values = {"rules": str(len(detector.file.rules))}
        values |= {f"problem {at}": problem for at, problem in enumerate(problems, start=1)}
        statuses.append(status("demandops_detector: rules", self._rules, level, text, values))

        level, text = DiagnosticStatus.OK, "detecting"
        if not is_started:
            level, text = DiagnosticStatus.WARN, "waiting for the bookkeeping or /clock"
        values = {
            "topics": str(topics.topics),
            "entities": str(detector.entities),
            "messages": str(topics.messages),
            "messages left out": str(topics.unreadable),
        }
        statuses.append(status("demandops_detector: data", self._rules, level, text, values))

        _, unanswered, refusals = sender.summary()
        level, text = DiagnosticStatus.OK, "every demand is answered"
        if unanswered:
            text = f"{unanswered} demands have no answer yet"
        if refusals:
            level = DiagnosticStatus.WARN
            text = f"{len(refusals)} demands failed and are tried again"
        values = {"events": str(len(detector.lasting)), "unanswered": str(unanswered)}
        for (rule, subjects), why in refusals[:_MOST_REFUSALS]:
            values[" ".join((rule, *subjects))] = why
        statuses.append(status("demandops_detector: demands", self._rules, level, text, values))

        message.status = statuses
        self._publisher.publish(message)


# ---- the node of the event detector, which watches topics and sends demands ----
#
# The node's decisions depend only on events, not on which services are deployed. The node reads the
# latched bookkeeping only at its start, to find the demands of its earlier run. So a restart does
# not end these demands.

_DISCOVERY_S = 0.5
_RELOAD_S = 1.0
_PATIENCE_S = 10.0
_MOST_OBSERVATIONS = 100_000
# The time that ROS reports until the first message of a simulated clock arrives.
_UNHEARD_CLOCK = 0.0
# If the clock jumps by more, someone has set the clock or restarted the simulation.
_SET_CLOCK_S = 1.0
_LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


class DetectorNode(Node):  # type: ignore[misc]
    def __init__(self, rules: str | None) -> None:
        super().__init__("demandops_detector")
        settings = detect_command.declare(self, rules)
        ros_process.log_to(self.get_logger(), settings["log_level"])
        self._path, self._settle_s = Path(settings["rules"]), float(settings["settling_time"])
        file, self._text = _read_rules(self._path)
        self._last_now, self._last_look = self._now(), REAL.monotonic()
        self._detector = Detector(file, self._last_now)
        self._is_started = False
        self._observations: deque[Observation] = deque(maxlen=_MOST_OBSERVATIONS)
        self._sender = DemandSender(
            settings["action_name"],
            settings["demand_action_name"],
            settings["answer_timeout"],
            self._log,
        )
        self._topics = self._subscribe(file)
        self._bookkeeping: Mapping[str, Any] | None = None
        self._books: Any = None
        if settings["bookkeeping_topic"]:
            self._books = self.create_subscription(
                Bookkeeping, settings["bookkeeping_topic"], self._hear_books, _LATCHED
            )
        else:
            self._bookkeeping = {}
        # by a steady clock, because a simulated one may be what is missing
        self._patience = self.create_timer(
            _PATIENCE_S, self._say_what_is_missing, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self.create_timer(settings["period"], self._step)
        self.create_timer(_DISCOVERY_S, self._refresh)
        self.create_timer(_RELOAD_S, self._reload_if_changed)
        self._diagnostics = DetectorDiagnostics(self, settings["rules"])
        self._problems: tuple[str, ...] = ()
        self.create_timer(1.0, self._report)

    def close(self) -> None:
        """Stop the node; its demands stay booked, those with a lease until it ends."""
        self._topics.close()
        self._sender.close()

    def _log(self, level: str, text: str) -> None:
        logger = self.get_logger()  # in rclpy, a line of code can log at one level only
        if level == "warning":
            logger.warning(one_line(text))
        else:
            logger.info(one_line(text))

    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds) / 1e9

    def _subscribe(self, file: RuleFile) -> SourceSubscriptions:
        topics = SourceSubscriptions(self, file, self._now, self._observe)
        topics.refresh()
        return topics

    def _observe(self, observation: Observation) -> None:
        if observation.at != _UNHEARD_CLOCK:
            self._observations.append(observation)

    # ---- start: find the demands of the earlier run ----

    def _hear_books(self, message: Any) -> None:  # noqa: ANN401 - a generated class
        try:
            bookkeeping = json.loads(message.bookkeeping_json)
            booked_events(self._detector.file, bookkeeping)
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            self._log(
                "warning",
                f"the bookkeeping cannot be read ({error!r}); check who publishes it; the next one "
                "is waited for",
            )
            return
        self._bookkeeping = bookkeeping

    def _start(self, bookkeeping: Mapping[str, Any], now: float) -> None:
        booked = booked_events(self._detector.file, bookkeeping)
        self._sender.want(self._detector.resume(booked, now, self._settle_s), booked)
        self._is_started = True
        self._last_now, self._last_look = now, REAL.monotonic()
        if self._books is not None:
            self.destroy_subscription(self._books)
        self._log(
            "info",
            f"detecting; rules: {len(self._detector.file.rules)}, demands booked before "
            f"the start: {len(booked)}",
        )

    def _say_what_is_missing(self) -> None:
        self._patience.cancel()
        if self._is_started:
            return
        if self._now() == _UNHEARD_CLOCK:
            missing = "use_sim_time is set, but no message on /clock has come, so nothing is "
            missing += "demanded; start a node that publishes /clock, or set use_sim_time to false"
        else:
            missing = "no bookkeeping has come, so nothing is demanded; start demandops serve, or "
            missing += "set the parameter bookkeeping_topic to the topic of the bookkeeping"
        self.get_logger().warning(missing)

    # ---- periodic work ----

    def _refresh(self) -> None:
        self._topics.refresh()  # of the rules in effect: a reload replaces this object

    def _step(self) -> None:
        now = self._now()
        if not self._is_started:
            if self._bookkeeping is None or now == _UNHEARD_CLOCK:
                return
            self._start(self._bookkeeping, now)
        observations = [self._observations.popleft() for _ in range(len(self._observations))]
        # if the clock was set since the last step, the detector's times are moved with it
        look, passed = REAL.monotonic(), now - self._last_now
        # a simulated clock may run at any speed, so only one that goes back was set
        is_simulated = bool(self.get_parameter("use_sim_time").value)
        jumped = min(passed, 0.0) if is_simulated else passed - (look - self._last_look)
        self._last_now, self._last_look = now, look
        if abs(jumped) > _SET_CLOCK_S:
            self._log("warning", f"the clock has jumped by {jumped:.1f} s")
            self._detector.set_clock(jumped)
        for event, want in self._detector.step(observations, now):
            self._log("info", f"rule {event.rule}: {event.why}")
            self._sender.want([want])

    def _reload_if_changed(self) -> None:
        """If the file is invalid, keep the last valid rules; log the problems if they changed."""
        try:
            _, text = read_input(self._path)
        except InvalidInput as error:
            self._text = ""  # any content that is read next counts as changed
            self._keep_rules(error)
            return
        if text == self._text or not self._is_started:
            return
        self._text = text
        try:
            file, _ = _read_rules(self._path)
        except InvalidInput as error:
            self._keep_rules(error)
            return
        self._problems = ()
        self._sender.want(self._detector.replace_rules(file, self._now(), self._settle_s))
        self._topics.close()
        self._topics = self._subscribe(file)
        self._log("info", f"the file has changed; rules: {len(file.rules)}")

    def _keep_rules(self, error: InvalidInput) -> None:
        problems = tuple(map(str, error.faults))
        if problems != self._problems:
            for problem in problems:
                self._log("warning", f"{problem}; the last valid rules stay in effect")
        self._problems = problems

    def _report(self) -> None:
        self._diagnostics.publish(
            self._problems, self._detector, self._topics, self._sender, self._is_started
        )


def _read_rules(path: Path) -> tuple[RuleFile, str]:
    """Return the rules in a file, whose message types are installed, and the file's text."""
    name, text = read_input(path)
    file = read(text, name)
    if faults := faults_of_types(file):
        raise InvalidInput(problem.within(name) for problem in faults)
    return file, text
