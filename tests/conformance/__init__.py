"""Rules that any server of the two actions can be tried against: `python -m tests.conformance`."""
