"""Checks of what a booking would deploy: denials, quotas, topic clashes and version differences."""
