"""Subscriptions to the topics that match the sources of rules.

Topics may appear and vanish at any time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any

from demandops.base.errors import Fault, fault
from demandops.base.quoting import one_line
from demandops.detect.condition import entity_in
from demandops.detect.detection_state import Observation
from demandops.detect.message_reader import MessageReader, Unreadable
from demandops.detect.rule_file import RuleFile
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy

# A subscription is reliable if all publishers that it finds are. The queue is deep, because many
# entities may share a topic.
_QOS = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_AVAILABLE)


def message_class(type_name: str) -> Any:  # noqa: ANN401 - a generated class
    package, _, name = type_name.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name, None)
    except ModuleNotFoundError:
        return None


def faults_of_types(file: RuleFile) -> list[Fault]:
    """Return a fault for each source whose message type is not installed."""
    return [
        fault(
            f"sources.{name}.type",
            f"{source.type} is not installed; install its package, or start the detector in a "
            "workspace that has it",
        )
        for name, source in file.sources.items()
        if message_class(source.type) is None
    ]


class SourceSubscriptions:
    def __init__(
        self,
        node: Node,
        file: RuleFile,
        now: Callable[[], float],
        observe: Callable[[Observation], None],
    ) -> None:
        self._node, self._file, self._now, self._observe = node, file, now, observe
        self._readers = {name: MessageReader(file, name) for name in file.sources}
        self._subscriptions: dict[tuple[str, str], Any] = {}
        self._told: set[str] = set()
        self.messages = self.unreadable = 0

    @property
    def topics(self) -> int:
        return len(self._subscriptions)  # a topic counts once for each source that reads it

    def refresh(self) -> None:
        """Subscribe to new topics, and leave those that nobody publishes any longer."""
        published: Mapping[str, list[str]] = dict(self._node.get_topic_names_and_types())
        for name, source in self._file.sources.items():
            for topic, types in published.items():
                entity = entity_in(source.topic, topic)
                if entity is None or (name, topic) in self._subscriptions:
                    continue
                if source.type not in types:
                    self._tell_once(
                        f"{topic} is not read, because its type is {', '.join(types)}, and source "
                        f"{name} reads {source.type}"
                    )
                elif self._node.count_publishers(topic):
                    self._subscriptions[name, topic] = self._node.create_subscription(
                        message_class(source.type),
                        topic,
                        partial(self._read, name, topic, entity),
                        _QOS,
                    )
        for key in [*self._subscriptions]:
            if not self._node.count_publishers(key[1]):
                self._node.destroy_subscription(self._subscriptions.pop(key))

    def close(self) -> None:
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.popitem()[1])

    def _read(self, source: str, topic: str, entity: str, message: Any) -> None:  # noqa: ANN401
        self.messages += 1
        try:
            self._observe(self._readers[source].observation(message, entity, self._now()))
        except Unreadable as error:
            self.unreadable += 1
            self._tell_once(f"a message on {topic} is left out: {error}")

    def _tell_once(self, text: str) -> None:
        if text not in self._told and len(self._told) < 1000:  # what is told is kept in memory
            self._told.add(text)
            self._node.get_logger().warning(one_line(text))
