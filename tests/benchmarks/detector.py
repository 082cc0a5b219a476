"""Measure the event detector: the engine alone, then the node with messages over ROS 2.

The engine gets 2,000 entities at 10 Hz, with 100 areas, a rule on pairs and a rule on a count. The
node gets poses of more and more entities at 10 Hz until it loses messages. First each entity has a
topic of its own, then all entities share one topic.
"""

from __future__ import annotations

import math
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from demandops.detect import rule_file
from demandops.detect.event_engine import EventEngine, Observation

from tests.kit.detection import POSE, rule, text_of

ENTITIES, HZ, SECONDS, WIDTH_M = 2000, 10, 10, 10_000
ROS_SECONDS = 6
OWN_TOPIC = {"cars": {"topic": "/cars/{entity}/pose", "type": POSE, "timeout": "5s"}}
ONE_TOPIC = {
    "cars": {"topic": "/poses", "type": POSE, "entity": "header.frame_id", "timeout": "5s"}
}


def rules() -> list[dict[str, Any]]:
    """Return 100 ``near`` rules, a ``together`` rule and a ``count`` rule."""
    areas = [
        rule(
            f"near-{number}",
            near={
                "source": "cars",
                "point": {"x": number % 10 * 1000 + 500, "y": number // 10 * 1000 + 500},
                "start": 84,
                "stop": 90,
            },
        )
        for number in range(100)
    ]
    middle = {"x": 5000, "y": 5000}
    count = {"source": "cars", "point": middle, "radius": 500, "start": 10, "stop": 5}
    pair = rule("pair", together={"source": "cars", "start": 30, "stop": 35})
    return [*areas, pair, rule("count", count=count)]


def engine() -> None:
    """Measure the engine with 2,000 entities that drive at 50 km/h; print the result."""
    run = EventEngine(rule_file.read(text_of(*rules()), "rules.yaml"))
    chance = random.Random(1)
    cars = [
        (chance.uniform(0, WIDTH_M), chance.uniform(0, WIDTH_M), chance.uniform(0, 6.28))
        for _ in range(ENTITIES)
    ]
    state, events, spent = run.start(0.0), 0, 0.0
    for step in range(1, SECONDS * HZ + 1):
        now, away = step / HZ, step * 13.9 / HZ
        seen = [
            Observation("cars", f"car{n}", now, (x + away * math.cos(h), y + away * math.sin(h)))
            for n, (x, y, h) in enumerate(cars)
        ]
        began = time.process_time()
        state, told = run.step(state, seen, now)
        spent += time.process_time() - began
        events += len(told)
    share, each = spent / SECONDS, spent / (SECONDS * HZ)
    print(
        f"engine: {ENTITIES} entities at {HZ} Hz, 102 rules: {each * 1000:.1f} ms for each "
        f"step of {1000 / HZ:.0f} ms, {share:.0%} of a core; {events} events"
    )


def over_ros(entities: int, sources: dict[str, Any]) -> tuple[int, int, float]:
    """Return how many poses were sent over ROS and read, and the detector's share of a core."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseStamped

    heard = {"messages": 0}
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
        own = "{entity}" in sources["cars"]["topic"]
        names = [f"car{number}" for number in range(entities)]
        topics = [f"/cars/{name}/pose" for name in names] if own else ["/poses"]
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
                message.pose.position.x, message.pose.position.y = number * 7.0, tick * 1.4
                publishers[number % len(publishers)].publish(message)
                sent += 1
            rclpy.spin_once(node, timeout_sec=0)
            time.sleep(max(0.0, began + (tick + 1) / HZ - time.monotonic()))
        took = time.monotonic() - began
        share = (cpu(detecting.pid) - used) / took
        for _ in range(40):
            rclpy.spin_once(node, timeout_sec=0.1)
        node.destroy_node()
        rclpy.shutdown()
        detecting.terminate()
        detecting.wait(20)
    return sent, heard["messages"] - before, share


def cpu(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    engine()
    for what, sources in (("a topic for each", OWN_TOPIC), ("one topic for all", ONE_TOPIC)):
        for entities in (10, 25, 50, 100, 200, 400, 800):
            sent, read, share = over_ros(entities, sources)
            print(
                f"node, {what}: {entities} entities at {HZ} Hz: {read / sent:.1%} of {sent} "
                f"messages read, {share:.0%} of a core",
                flush=True,
            )
            if read < 0.99 * sent:
                break


if __name__ == "__main__":
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 100)))
    main()
