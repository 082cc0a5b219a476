"""Generators in one thread with people and faults, all from a seed: ``make simulate``."""
