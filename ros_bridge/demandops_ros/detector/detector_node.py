"""The node of the event detector: subscriptions, demands that it sends, diagnostics."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import import_module
from math import inf
from operator import itemgetter
from pathlib import Path
from typing import Any

import click
from application_manager_interfaces.action import DeploymentRequest
from demandops.base.errors import InvalidInput, fault
from demandops.base.quoting import one_line, quoted
from demandops.base.runtime import REAL, log
from demandops.base.settings import DEFAULT_ACTION_NAME, DEFAULT_DEMAND_ACTION_NAME
from demandops.base.strict_yaml import read_input
from demandops.detect.condition import entity_in
from demandops.detect.detector import Detector, Outcome, Sending, Want, WantedDemands, booked_events
from demandops.detect.event_engine import Key, Observation
from demandops.detect.message_reader import (
    TF_TOPICS,
    TF_TYPE,
    FrameTree,
    MessageReader,
    NoTransform,
    Unreadable,
)
from demandops.detect.rule_file import Goal, RuleFile, read
from demandops_interfaces.msg import Bookkeeping
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy

from demandops_ros import ros_process
from demandops_ros.actions import DemandError, GoalSender
from demandops_ros.client import DemandClient
from demandops_ros.demand_node import LATCHED, Diagnostics
from demandops_ros.messages import fill_message
from demandops_ros.node_parameters import (
    LOG_LEVEL,
    Parameter,
    declare,
    read_parameters,
    ros_name,
    ros_name_or_none,
)

# ---- its parameters ----

PARAMETERS = {
    "rules": Parameter("", "File of rules."),
    "action_name": Parameter(
        DEFAULT_ACTION_NAME,
        "Name of the action DeploymentRequest, for rules that send it.",
        read=ros_name,
    ),
    "demand_action_name": Parameter(
        DEFAULT_DEMAND_ACTION_NAME,
        "Name of the action Demand, for rules that send it.",
        read=ros_name,
    ),
    "bookkeeping_topic": Parameter(
        "/demandops/bookkeeping",
        "Topic of the bookkeeping that the detector reads at its start. Without a topic, the "
        "detector does not read the bookkeeping.",
        read=ros_name_or_none,
    ),
    "settling_time": Parameter(
        10.0,
        "After the start or a change of the rules, an entity of a booked demand counts as gone if "
        "it stays unseen for this many seconds, or for the timeout of its source if that is "
        "longer.",
        span=(0.1, 3_600.0),
    ),
    "period": Parameter(
        0.1, "Seconds between two evaluations of received messages.", span=(0.01, 10.0)
    ),
    "answer_timeout": Parameter(
        60.0, "How many seconds a goal may wait for its answer.", span=(1.0, 86_400.0)
    ),
    "log_level": LOG_LEVEL,
}


# ---- subscriptions to the topics that match the sources of rules ----
#
# Topics may appear and vanish at any time. Their messages are taken when the detector steps, many
# at a time: rclpy's executor would wake for each, which costs more than to read it. They are read
# in the order in which they came, so that a bag that was recorded meanwhile gives the same events.

# The queue is deep, because many entities may share a topic.
_QOS = QoSProfile(depth=10_000, reliability=QoSReliabilityPolicy.RELIABLE)
# A reliable subscription hears only reliable publishers, so it is replaced when another one comes.
_LOSSY_QOS = QoSProfile(depth=10_000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
# Whoever tells of static frames told it once, and keeps it for who comes later.
_STATIC_QOS = QoSProfile(depth=1000, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


class _NoCallbacks(CallbackGroup):  # type: ignore[misc]
    def can_execute(self, _: object) -> bool:
        return False


def message_class(type_name: str) -> Any:  # noqa: ANN401 - a generated class
    package, _, name = type_name.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name, None)
    except ModuleNotFoundError:
        return None


class SourceSubscriptions:
    def __init__(
        self,
        node: Node,
        file: RuleFile,
        now: Callable[[], float],
    ) -> None:
        self._node, self._file, self._now = node, file, now
        self._group = _NoCallbacks()
        self._frames = FrameTree(file.map.frame) if file.map and file.map.frame else None
        self._readers = {name: MessageReader(file, name, self._frames) for name in file.sources}
        # by source and topic, with the entity that the topic names
        self.subscriptions: dict[tuple[str, str], tuple[Any, str]] = {}
        self._of_frames = {
            topic: self._subscribe(TF_TYPE, topic, _STATIC_QOS if is_static else _LOSSY_QOS)
            for topic, is_static in (TF_TOPICS if self._frames else {}).items()
        }
        # the keys of subscriptions that had messages since the last refresh, or before that one
        self._heard: set[tuple[str, str]] = set()
        self._heard_before: set[tuple[str, str]] = set()
        self._told: set[str] = set()
        self.messages = self.unreadable = 0

    def _subscribe(self, type_name: str, topic: str, qos: QoSProfile) -> Any:  # noqa: ANN401
        return self._node.create_subscription(
            message_class(type_name), topic, lambda _: None, qos, callback_group=self._group
        )

    def refresh(self) -> None:
        # Who was heard lately publishes. Silent for one turn alone, it may have left a message.
        silent = self.subscriptions.keys() - self._heard - self._heard_before
        self._heard, self._heard_before = set(), self._heard
        shared = {key for key, (_, entity) in self.subscriptions.items() if not entity}
        for key in silent | shared:
            subscription, topic = self.subscriptions[key][0], key[1]
            publishers = self._node.count_publishers(topic)
            misses_some = publishers > subscription.get_publisher_count()
            must_change = misses_some and subscription.qos_profile == _QOS != self._qos(topic)
            if must_change or (not publishers and key in silent):
                self._node.destroy_subscription(self.subscriptions.pop(key)[0])
        published: Mapping[str, list[str]] = dict(self._node.get_topic_names_and_types())
        for name, source in self._file.sources.items():
            for topic, types in published.items():
                if (name, topic) in self.subscriptions:
                    continue
                if (entity := entity_in(source.topic, topic)) is None:
                    continue
                if source.type not in types:
                    self._tell_once(
                        f"{topic} is not read, because its type is {', '.join(types)}, and source "
                        f"{name} reads {source.type}"
                    )
                elif qos := self._qos(topic):
                    subscription = self._subscribe(source.type, topic, qos)
                    self.subscriptions[name, topic] = subscription, entity

    def _qos(self, topic: str) -> QoSProfile | None:
        """Return the quality at which all publishers are heard, ``None`` if there are none."""
        publishers = self._node.get_publishers_info_by_topic(topic)
        offered = {each.qos_profile.reliability for each in publishers}
        return (_LOSSY_QOS if _LOSSY_QOS.reliability in offered else _QOS) if offered else None

    def close(self) -> None:
        for each in (*self._of_frames.values(), *(each for each, _ in self.subscriptions.values())):
            self._node.destroy_subscription(each)
        self.subscriptions, self._of_frames = {}, {}

    def take(self) -> list[Observation]:
        """Return what the messages report that have come since the last call."""
        now, is_simulated = self._now(), self._node.get_clock().ros_time_is_active
        came: list[tuple[int, str, str, str, Any]] = []
        for topic, subscription in self._of_frames.items():
            came += ((at, "", topic, "", each) for at, each in _taken(subscription))
        for (source, topic), (subscription, entity) in self.subscriptions.items():
            before = len(came)
            came += ((at, source, topic, entity, each) for at, each in _taken(subscription))
            if len(came) > before:
                self._heard.add((source, topic))
        observations = []
        for received, source, topic, entity, message in sorted(came, key=itemgetter(0)):
            at = now if is_simulated or not received else received / 1e9
            if self._frames and not source:
                self._frames.hear(message, TF_TOPICS[topic], at)
                continue
            self.messages += 1
            try:
                if heard := self._readers[source].observation(message, entity, at):
                    observations.append(heard)
            except Unreadable as error:
                self.unreadable += 1
                # many topics may lack the same frame
                of_topic = not isinstance(error, NoTransform)
                self._tell_once(
                    f"a message on {topic} is left out: {error}" if of_topic else str(error)
                )
        return observations

    def _tell_once(self, text: str) -> None:
        if text not in self._told and len(self._told) < 1000:  # what is told is kept in memory
            self._told.add(text)
            self._node.get_logger().warning(one_line(text))


def _taken(subscription: Any) -> Iterator[tuple[int, Any]]:  # noqa: ANN401
    # at most what the queue holds, so that a fast publisher does not keep the detector here
    with subscription.handle:
        for _ in range(_QOS.depth):
            if (taken := subscription.handle.take_message(subscription.msg_type, False)) is None:
                return
            yield taken[1]["received_timestamp"], taken[0]


# ---- the demands of events, sent in separate threads and again after a failure ----

# How many goals are sent at the same time; the node publishes such goals together.
_THREADS = 8
_LONGEST_WAIT_S = 60.0


class DemandSender:
    def __init__(self, action_name: str, demand_action_name: str, timeout_s: float) -> None:
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
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._demands.close()
        self._requests.close()

    def want(self, wants: Iterable[Want], booked: Mapping[Key, Goal] | None = None) -> None:
        # ``booked`` has the events whose demands were booked before the detector started, each with
        # a goal that can end the demand
        with self._changed:
            for key, goal in (booked or {}).items():
                self._wanted.hold(key, goal)
            for want in wants:
                self._wanted.want(want)
            self._changed.notify_all()

    def summary(self) -> tuple[int, list[tuple[Key, str]]]:
        # how many events have no answer to their demand yet, and why the last goal of others failed
        with self._changed:
            return self._wanted.unanswered(), list(self._wanted.refusals())

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
            if told and not self._is_closed:
                log.warning("rule %s: %s failed and will be tried again: %s", rule, what, told)
            elif not outcome.code and sending.purpose != "renew":
                log.info("rule %s: %s: %s", rule, what, outcome.message)

    def _take(self) -> Sending | None:
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
            if goal.action == "Demand":
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


# ---- the node ----
#
# The node's decisions depend only on events, not on which services are deployed. The node reads the
# latched bookkeeping only at its start, to find the demands of its earlier run. So a restart does
# not end these demands.

_MOST_REFUSALS = 20  # that the diagnostics list
# How long messages may wait in their queues
_TAKE_S = 0.1
# How many observations are kept until the detector has started
_MOST_OBSERVATIONS = 100_000
# The time that ROS reports until the first message of a simulated clock arrives.
_UNHEARD_CLOCK = 0.0
# If the clock jumps by more, someone has set the clock or restarted the simulation.
_SET_CLOCK_S = 1.0


def read_bookkeeping(text: str, file: RuleFile) -> Mapping[str, Any] | None:
    try:
        bookkeeping: Mapping[str, Any] = json.loads(text)
        booked_events(file, bookkeeping)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        log.warning(
            "the bookkeeping cannot be read (%r); check who publishes it; the next one is waited "
            "for",
            error,
        )
        return None
    return bookkeeping


class DetectorNode(Node):  # type: ignore[misc]
    def __init__(self, rules: str | None) -> None:
        super().__init__("demandops_detector")
        settings = read_parameters("demandops_detector", PARAMETERS, {"rules": rules})
        if not settings["rules"]:
            raise click.UsageError("no rules given; name a file, or set the ROS parameter 'rules'")
        declare(self, PARAMETERS, settings)
        ros_process.log_to(self.get_logger(), settings["log_level"])
        self._rules, self._settle_s = settings["rules"], float(settings["settling_time"])
        self._path = Path(self._rules)
        file, self._text = _read_rules(self._path)
        self._last_now, self._last_look = self._now(), REAL.monotonic()
        self._detector = Detector(file, self._last_now)
        self._is_started = False
        self._observations: list[Observation] = []
        self._sender = DemandSender(
            settings["action_name"],
            settings["demand_action_name"],
            settings["answer_timeout"],
        )
        self._topics = self._subscribe(file)
        self._bookkeeping: Mapping[str, Any] | None = None
        self._books: Any = None

        def hear(message: Any) -> None:  # noqa: ANN401 - a generated class
            heard = read_bookkeeping(message.bookkeeping_json, self._detector.file)
            self._bookkeeping = self._bookkeeping if heard is None else heard

        if topic := settings["bookkeeping_topic"]:
            self._books = self.create_subscription(Bookkeeping, topic, hear, LATCHED)
        else:
            self._bookkeeping = {}
        # by a steady clock, because a simulated one may be what is missing
        self._patience = self.create_timer(
            10.0, self._say_what_is_missing, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self.create_timer(settings["period"], self._step)
        if settings["period"] > _TAKE_S:
            self.create_timer(_TAKE_S, self._take)
        # a reload replaces the subscriptions, so this timer is not bound to those of now
        self.create_timer(0.5, lambda: self._topics.refresh())  # noqa: PLW0108
        self.create_timer(1.0, self._reload_if_changed)
        self._diagnostics = Diagnostics(self, "demandops_detector", self._rules)
        self._problems: tuple[str, ...] = ()
        self.create_timer(1.0, self._report)

    def close(self) -> None:
        self._topics.close()
        self._sender.close()

    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds) / 1e9

    def _subscribe(self, file: RuleFile) -> SourceSubscriptions:
        topics = SourceSubscriptions(self, file, self._now)
        topics.refresh()
        return topics

    # ---- start: find the demands of the earlier run ----

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
        log.warning("%s", missing)

    # ---- periodic work ----

    def _take(self) -> None:
        taken = self._topics.take()
        if self._now() != _UNHEARD_CLOCK:
            self._observations = (self._observations + taken)[-_MOST_OBSERVATIONS:]

    def _step(self) -> None:
        self._take()
        now = self._now()
        if not self._is_started:
            if self._bookkeeping is None or now == _UNHEARD_CLOCK:
                return
            booked = booked_events(self._detector.file, self._bookkeeping)
            self._sender.want(self._detector.resume(booked, now, self._settle_s), booked)
            self._is_started = True
            self._last_now, self._last_look = now, REAL.monotonic()
            if self._books is not None:
                self.destroy_subscription(self._books)
            log.info(
                "detecting; rules: %d, demands booked before the start: %d",
                len(self._detector.file.rules),
                len(booked),
            )
        observations, self._observations = self._observations, []
        # if the clock was set since the last step, the detector's times are moved with it
        look, passed = REAL.monotonic(), now - self._last_now
        # a simulated clock may run at any speed, so only one that goes back was set
        is_simulated = bool(self.get_parameter("use_sim_time").value)
        jumped = min(passed, 0.0) if is_simulated else passed - (look - self._last_look)
        self._last_now, self._last_look = now, look
        if abs(jumped) > _SET_CLOCK_S:
            log.warning("the clock has jumped by %.1f s", jumped)
            self._detector.set_clock(jumped)
        for event, want in self._detector.step(observations, now):
            log.info("rule %s: %s", event.rule, event.why)
            self._sender.want([want])

    def _reload_if_changed(self) -> None:
        # while the file is invalid, the last valid rules stay in effect
        text = ""
        try:
            _, text = read_input(self._path)
            if text == self._text or not self._is_started:
                return
            file, _ = _read_rules(self._path)
        except InvalidInput as error:
            problems = tuple(map(str, error.faults))
            for problem in problems if problems != self._problems else ():
                log.warning("%s; the last valid rules stay in effect", one_line(problem))
            self._text, self._problems = text, problems
            return
        self._text, self._problems = text, ()
        self._sender.want(self._detector.replace_rules(file, self._now(), self._settle_s))
        self._topics.close()
        self._topics = self._subscribe(file)
        log.info("the file has changed; rules: %d", len(file.rules))

    def _report(self) -> None:
        detector, add = self._detector, self._diagnostics.add
        invalid = "the file cannot be read or is invalid; the last valid rules are in effect"
        values = {"rules": str(len(detector.file.rules))}
        values |= {f"problem {at}": problem for at, problem in enumerate(self._problems, start=1)}
        add("rules", "valid", values, warning=invalid if self._problems else "")

        missing = "" if self._is_started else "waiting for the bookkeeping or /clock"
        values = {
            "topics": str(len(self._topics.subscriptions)),
            "entities": str(detector.entities),
            "messages": str(self._topics.messages),
            "messages left out": str(self._topics.unreadable),
        }
        add("data", "detecting", values, warning=missing)

        unanswered, refusals = self._sender.summary()
        text, failed = "every demand is answered", ""
        if unanswered:
            text = f"{unanswered} demands have no answer yet"
        if refusals:
            failed = f"{len(refusals)} demands failed and are tried again"
        values = {"events": str(len(detector.lasting)), "unanswered": str(unanswered)}
        for (rule, subjects), why in refusals[:_MOST_REFUSALS]:
            values[" ".join((rule, *subjects))] = why
        add("demands", text, values, warning=failed)
        self._diagnostics.publish()


def _read_rules(path: Path) -> tuple[RuleFile, str]:
    place, text = read_input(path)
    file = read(text, place)
    remedy = "build it from the folder of its definitions (docs/detector.md#messages), or start "
    remedy += "the detector in a workspace that has it"
    faults = [
        fault(f"sources.{name}.type", f"{source.type} is not installed; {remedy}")
        for name, source in file.sources.items()
        if message_class(source.type) is None
    ]
    if file.map and file.map.frame and message_class(TF_TYPE) is None:
        faults.append(fault("map.frame", f"needs {TF_TYPE}, which is not installed; {remedy}"))
    if faults:
        raise InvalidInput(problem.within(place) for problem in faults)
    return file, text
