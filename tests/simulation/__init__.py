"""Generators in one thread by a seed, with people and faults: ``make simulate``."""
