"""What all tests share: goals, configuration, repos, the command line, generators, HTTP, ROS."""
