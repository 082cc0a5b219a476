"""The event detector without ROS: rules, events, and the demands that they want."""
