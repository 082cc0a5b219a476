"""From a submitted demand to its receipt: the process that does the work."""
