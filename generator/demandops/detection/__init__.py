"""The event detector: rules over what entities report, and the demands of these rules.

Pure: no ROS, no clock, no disk. ``demandops_ros`` feeds it with messages and sends the demands.
"""
