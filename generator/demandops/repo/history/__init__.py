"""Commits: their log, their messages and authors, and how people name them."""
