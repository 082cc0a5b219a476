"""The event detector: a node that watches topics, and sends the demands that its rules ask for."""
