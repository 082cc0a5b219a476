"""The audit: checks of the signatures of commits, and of their files."""
