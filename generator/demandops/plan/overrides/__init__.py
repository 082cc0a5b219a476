"""Overrides: which claims and releases an override selects, and how it changes them."""
