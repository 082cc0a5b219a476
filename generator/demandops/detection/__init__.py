"""The event detector: rules over what entities report, and the demands of these rules.

This package uses no ROS, no clock and no disk. ``demandops_ros`` gives it the messages, and sends
the demands.
"""
