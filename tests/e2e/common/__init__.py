"""What the tests of both controllers share, from a ROS 2 goal to the pods."""
