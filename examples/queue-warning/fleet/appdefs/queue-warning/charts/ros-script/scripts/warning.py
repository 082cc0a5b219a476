"""Warns while a density is above 20: warning.py WARNING_TOPIC DENSITY_TOPIC…"""

import sys

import rclpy
from std_msgs.msg import Float32, String

warning_topic, *density_topics = sys.argv[1:]
rclpy.init()
node = rclpy.create_node("warning")
publisher = node.create_publisher(String, warning_topic, 10)


def watch(topic: str) -> None:
    def take(density: Float32) -> None:
        if density.data > 20:
            publisher.publish(String(data=f"queue ahead: {topic} is {density.data:.0f}"))

    node.create_subscription(Float32, topic, take, 10)


for each in density_topics:
    watch(each)
rclpy.spin(node)
