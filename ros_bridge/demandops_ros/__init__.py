"""The ROS 2 bridge: demands come in over an action, receipts go back.

Stands above the generator and is the only package that knows rclpy.
"""
