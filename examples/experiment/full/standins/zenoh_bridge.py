"""A stand-in for zenoh-bridge-ros2dds: it carries serialized ROS messages over the real Zenoh.

It reads the real configuration. The real bridge is a plugin that Zenoh's Python wheels lack. Unlike
the real bridge, the stand-in sends a topic's type with each message.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any

import zenoh
from rclpy.node import Node

from .running import message_class, spin, start

_LOOK_S = 0.1


class Bridge(Node):
    """The bridge of one node, for all connections of the node."""

    def __init__(self, plugin: dict[str, Any], session: Any) -> None:
        super().__init__(plugin["nodename"])
        self._session = session
        self._given, self._taken = (
            re.compile("|".join(plugin["allow"].get(ends, ["(?!)"])))
            for ends in ("publishers", "subscribers")
        )
        self._readers: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}
        self._arrivals = session.declare_subscriber("**", self._take)
        self.create_timer(_LOOK_S, self._subscribe_new)

    def _subscribe_new(self) -> None:
        """Subscribe to the new topics in the ROS graph that the configuration allows to be sent."""
        for topic, (kind, *_) in self.get_topic_names_and_types():
            if topic not in self._readers and self._given.search(topic):
                self._readers[topic] = self.create_subscription(
                    message_class(kind),
                    topic,
                    lambda data, t=topic, k=kind: self._session.put(t[1:], data, attachment=k),
                    10,
                    raw=True,
                )

    def _take(self, sample: Any) -> None:
        topic = f"/{sample.key_expr}"
        if not self._taken.search(topic):
            return
        if topic not in self._writers:
            kind = message_class(sample.attachment.to_string())
            self._writers[topic] = self.create_publisher(kind, topic, 10)
        self._writers[topic].publish(sample.payload.to_bytes())


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("-c", dest="config", type=Path, required=True)
    config = json.loads(parser.parse_args().config.read_text())
    plugin = config.pop("plugins")["ros2dds"]
    start(domain=plugin["domain"])
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        spin(Bridge(plugin, session))


if __name__ == "__main__":
    main()
