"""Checks of a booking by its plan: quotas and denials."""
