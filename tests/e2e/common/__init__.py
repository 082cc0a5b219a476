"""The real chain: a ROS 2 goal becomes a commit, and Flux makes a cluster look like it."""
