"""The event detector: a node that watches topics and demands by rules."""
