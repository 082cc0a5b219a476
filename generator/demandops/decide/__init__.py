"""The decision on one demand, from its goal to rendered files. Pure."""
