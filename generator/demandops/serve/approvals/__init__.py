"""Demands that wait for a person: proposals, pull requests, answers."""
