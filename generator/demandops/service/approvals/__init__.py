"""Demands that wait for a person to merge their branch."""
