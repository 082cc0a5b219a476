"""The detector's status on ``/diagnostics``: its rules, its data and its demands."""

from __future__ import annotations

from collections.abc import Sequence

from demandops.detection.detector import Detector
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from demandops_ros.detector.demand_sender import DemandSender
from demandops_ros.detector.source_subscriptions import SourceSubscriptions
from demandops_ros.diagnostics import status

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
