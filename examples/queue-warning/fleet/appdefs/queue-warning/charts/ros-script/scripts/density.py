"""Publishes the mean of the last ten counts of cars: density.py COUNTS_TOPIC DENSITY_TOPIC."""

import sys
from collections import deque

import rclpy
from std_msgs.msg import Float32, Int32

counts_topic, density_topic = sys.argv[1:]
rclpy.init()
node = rclpy.create_node("density")
publisher = node.create_publisher(Float32, density_topic, 10)
last = deque(maxlen=10)


def take(count: Int32) -> None:
    last.append(count.data)
    publisher.publish(Float32(data=sum(last) / len(last)))


node.create_subscription(Int32, counts_topic, take, 10)
rclpy.spin(node)
