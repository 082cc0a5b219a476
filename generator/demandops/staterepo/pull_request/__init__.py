"""Checks of pull requests: of checkouts of a state repo that people are about to merge."""
