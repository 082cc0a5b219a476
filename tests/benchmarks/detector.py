"""Measure the event detector: the rules alone, then the node with messages over ROS 2.

The rules get poses of 5,000 entities at 10 Hz, with 100 areas, a rule on pairs and one on a count.
The node gets poses of more and more entities at 10 Hz until it loses messages. First each entity
has a topic of its own, then all entities share one topic.
"""

from __future__ import annotations

import math
import os
import random
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

from demandops.detect import rule_file
from demandops.detect.event_engine import EventEngine
from demandops.detect.message_reader import MessageReader

from tests.kit.detection import POSE, rule, text_of

ENTITIES, HZ, SECONDS, WIDTH_M = 5000, 10, 4, 10_000
ROS_SECONDS = 6
_CARS = {"topic": "/cars/{entity}/pose", "type": POSE, "timeout": "5s"}
OWN_TOPIC = {"cars": _CARS}
ONE_TOPIC = {"cars": _CARS | {"topic": "/poses", "entity": "header.frame_id"}}


def rules() -> list[dict[str, Any]]:
    """Return 100 ``near`` rules, a ``together`` rule and a ``count`` rule."""
    centers = [
        {"x": x, "y": y} for y in range(500, WIDTH_M, 1000) for x in range(500, WIDTH_M, 1000)
    ]
    near = {"source": "cars", "start": 84, "stop": 90}
    areas = [rule(f"near-{n}", near=near | {"point": point}) for n, point in enumerate(centers)]
    middle = {"x": 5000, "y": 5000}
    count = {"source": "cars", "point": middle, "radius": 500, "start": 10, "stop": 5}
    pair = rule("pair", together={"source": "cars", "start": 30, "stop": 35})
    return [*areas, pair, rule("count", count=count)]


def without_ros() -> None:
    """Measure deserializing, reading and the rules, for entities that drive at 50 km/h."""
    from geometry_msgs.msg import PoseStamped
    from rclpy.serialization import deserialize_message, serialize_message

    file = rule_file.read(text_of(*rules()), "rules.yaml")
    engine, reader = EventEngine(file), MessageReader(file, "cars")
    chance = random.Random(1)
    cars = [
        (chance.uniform(0, WIDTH_M), chance.uniform(0, WIDTH_M), chance.uniform(0, 6.28))
        for _ in range(ENTITIES)
    ]
    state, events, message = engine.start(0.0), 0, PoseStamped()
    spent = dict.fromkeys(("deserializing", "reading", "rules"), 0.0)
    for step in range(1, SECONDS * HZ + 1):
        now, away = step / HZ, step * 13.9 / HZ
        sent = []
        for x, y, heading in cars:
            message.pose.position.x = x + away * math.cos(heading)
            message.pose.position.y = y + away * math.sin(heading)
            sent.append(serialize_message(message))
        times = [time.process_time()]
        heard = [deserialize_message(data, PoseStamped) for data in sent]
        times.append(time.process_time())
        seen = [reader.observation(each, f"car{n}", now) for n, each in enumerate(heard)]
        times.append(time.process_time())
        state, told = engine.step(state, filter(None, seen), now)
        times.append(time.process_time())
        for name, (began, ended) in zip(spent, pairwise(times), strict=True):
            spent[name] += ended - began
        events += len(told)
    each = {name: f"{used / SECONDS / HZ / ENTITIES * 1e6:.1f} us" for name, used in spent.items()}
    own, share = spent["reading"] + spent["rules"], 1 / SECONDS
    print(
        f"rules: {ENTITIES} entities at {HZ} Hz, 102 rules: for a message {each}; reading and "
        f"rules take {own * share:.0%} of a core, {1 + own / spent['deserializing']:.2f} times as "
        f"much with deserializing as deserializing alone; {events} events"
    )


def over_ros(entities: int, sources: dict[str, Any]) -> tuple[int, int, float]:
    """Return how many poses were sent over ROS and read, and the processor's seconds for it."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseStamped

    heard, names = {"messages": 0}, [f"car{number}" for number in range(entities)]
    topics = list(dict.fromkeys(sources["cars"]["topic"].format(entity=name) for name in names))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "rules.yaml")
        path.write_text(text_of(*rules(), sources=sources))
        options = ["-p", "bookkeeping_topic:=''", "-p", f"rules:={path}"]
        command = [sys.executable, "-m", "demandops.cli.main", "detect", "--ros-args", *options]
        detecting = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        rclpy.init()
        node = rclpy.create_node("fleet")

        def hear(message: Any) -> None:
            for status in message.status:
                if status.name == "demandops_detector: data":
                    heard.update((one.key, int(one.value)) for one in status.values)

        node.create_subscription(DiagnosticArray, "/diagnostics", hear, 10)
        publishers = [node.create_publisher(PoseStamped, topic, 1000) for topic in topics]
        message = PoseStamped()
        while heard.get("topics", 0) < len(topics) or not all(
            publisher.get_subscription_count() for publisher in publishers
        ):
            rclpy.spin_once(node, timeout_sec=0.1)
        before, used, sent = heard["messages"], cpu(detecting.pid), 0
        began = time.monotonic()
        for tick in range(ROS_SECONDS * HZ):
            for number, name in enumerate(names):
                message.header.frame_id = name
                message.pose.position.x, message.pose.position.y = number * 50.0, tick * 1.4
                publishers[number % len(publishers)].publish(message)
                sent += 1
            rclpy.spin_once(node, timeout_sec=0)
            time.sleep(max(0.0, began + (tick + 1) / HZ - time.monotonic()))
        spent = cpu(detecting.pid) - used
        end = time.monotonic() + 4
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.1)
        node.destroy_node()
        rclpy.shutdown()
        detecting.terminate()
        detecting.wait(timeout=20)
    return sent, heard["messages"] - before, spent


def cpu(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    without_ros()
    for what, sources in (("a topic for each", OWN_TOPIC), ("one topic for all", ONE_TOPIC)):
        for entities in (50, 100, 200, 400, 800, 1600):
            sent, read, spent = over_ros(entities, sources)
            used = f"{spent / ROS_SECONDS:.0%} of a core; {spent / read * 1e6:.0f} us for a message"
            share = f"{read / sent:.1%} of {sent} messages read"
            print(f"node, {what}: {entities} entities at {HZ} Hz: {share}, {used}", flush=True)
            if read < 0.99 * sent:
                break


if __name__ == "__main__":
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 100)))
    main()
