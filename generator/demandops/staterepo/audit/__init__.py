"""Audits commits: checks their signatures, their generated files, and which files they changed."""
