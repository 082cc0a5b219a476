"""Code that the end-to-end tests with Flux and Argo CD share, from a ROS 2 goal to the pods."""
