"""Differences between two states of the rendered files."""
