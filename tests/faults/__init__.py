"""Faults of disk, power and process at every system call of one demand: ``make faults``."""
