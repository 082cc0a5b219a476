"""Histories of generators, people and faults in one thread, all from a seed: ``make simulate``."""
