"""Proof: commits are what books and configuration give, and are signed."""
