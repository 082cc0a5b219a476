"""Checks pull requests: whether the edits in a checkout of a state repo can be merged."""
