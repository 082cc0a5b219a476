"""Commits are written: by the generator in batches, by people one at a time."""
