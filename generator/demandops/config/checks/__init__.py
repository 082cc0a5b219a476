"""Checks across files: each file is valid alone, but they may contradict each other."""
