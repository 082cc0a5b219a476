"""Checks of a pull request: a checked-out state repo that a person is about to merge."""
