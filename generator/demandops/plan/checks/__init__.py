"""Checks of a booking by its plan (quotas, denials), and trial demands for a configuration."""
