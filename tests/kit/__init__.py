"""The tools of all tests: goals, configuration, repos, the command line, generators, HTTP, ROS."""
