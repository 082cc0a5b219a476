"""Demands that wait until a person merges or rejects their branch."""
