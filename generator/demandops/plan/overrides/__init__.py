"""Overrides: which claims and releases they select, and what they do to them."""
