"""What the end-to-end tests with Flux and with Argo CD share, from a ROS 2 goal to the pods."""
