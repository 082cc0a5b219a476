"""Checks of a booking by its plan: denials, quotas and topic clashes."""
