"""Messages that a detector hears live, and a bag in which they were recorded meanwhile.

As a program, it publishes the messages of its standard input and records what it hears of them.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

from tests.kit.limits import PATIENCE_S
from tests.kit.rig import wait_until

# A topic, its type, and the fields of a message
Step = tuple[str, str, dict[str, Any]]

DEFINITIONS = Path(__file__).parents[1] / "fixtures" / "messages"


def heard_live(
    rules: Path, steps: Iterable[Step], events: int, domain: int, python: str = sys.executable
) -> str:
    """Return the log of a detector until it told ``events`` events; record beside ``rules``."""
    log, bag = rules.with_suffix(".log"), rules.with_name("bag")
    # the wheels of another environment look for their own libraries
    foreign = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH")
    environment = {name: text for name, text in os.environ.items() if name not in foreign}
    environment["ROS_DOMAIN_ID"] = str(domain)
    detect = [python, "-m", "demandops.cli.main", "detect", str(rules), "--ros-args"]
    with log.open("w") as sink:
        detecting = subprocess.Popen(
            [*detect, "-p", "bookkeeping_topic:=''"], env=environment, stdout=sink, stderr=sink
        )
    try:
        command = [python, "-m", "tests.kit.live", str(bag)]
        text = json.dumps([*steps])
        subprocess.run(
            command, input=text, env=environment, text=True, check=True, timeout=PATIENCE_S
        )
        wait_until(lambda: len(told(log.read_text())) >= events, "events are told")
        detecting.terminate()
        assert detecting.wait(PATIENCE_S) == 0
    finally:
        detecting.kill()
        detecting.wait(PATIENCE_S)
    return log.read_text()


def told(log: str) -> list[str]:
    return re.findall(r"rule \S+: .*(?: from the area| is \d.*)", log)


def main(bag: str) -> None:
    import rclpy
    from demandops.detect.message_reader import TF_TOPICS
    from demandops_ros.messages import fill_message
    from rclpy.qos import QoSDurabilityPolicy, QoSProfile
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_KILTED)
    for package, folder in {"fleet_msgs": "fleet_msgs", "hazard_msgs": "warnings"}.items():
        for path in (DEFINITIONS / folder).rglob("*.msg"):
            types.register(get_types_from_msg(path.read_text(), f"{package}/msg/{path.stem}"))
    steps: list[Step] = json.load(sys.stdin)
    rclpy.init()
    node = rclpy.create_node("drive")
    recorded = 0
    with Writer(bag, version=9) as writer:
        publishers, classes = {}, {}
        for topic, type_name, _ in steps:
            if topic in publishers:
                continue
            package, _, name = type_name.split("/")
            classes[topic] = getattr(import_module(f"{package}.msg"), name)
            kept = QoSDurabilityPolicy.TRANSIENT_LOCAL if TF_TOPICS.get(topic) else None
            qos = QoSProfile(depth=100, **({"durability": kept} if kept else {}))
            connection = writer.add_connection(topic, type_name, typestore=types)

            def record(data: bytes, info: Any, connection: Any = connection) -> None:
                nonlocal recorded
                writer.write(connection, info["received_timestamp"], data)
                recorded += 1

            publishers[topic] = node.create_publisher(classes[topic], topic, qos)
            node.create_subscription(classes[topic], topic, record, qos, raw=True)

        def are_heard() -> bool:  # by the detector too
            rclpy.spin_once(node, timeout_sec=0.1)
            return all(each.get_subscription_count() >= 2 for each in publishers.values())

        wait_until(are_heard, "each topic has two subscribers")
        for number, (topic, _, fields) in enumerate(steps):
            publishers[topic].publish(fill_message(classes[topic](), fields))
            while recorded <= number:
                rclpy.spin_once(node, timeout_sec=0.1)
    os._exit(0)  # the bag is closed; rclpy's own end was seen to crash on a busy machine


if __name__ == "__main__":
    main(sys.argv[1])
