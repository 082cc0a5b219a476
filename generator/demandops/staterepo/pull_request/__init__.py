"""Checks pull requests: reads a checkout of a state repo before a person merges the edit."""
