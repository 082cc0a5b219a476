"""Audit: commits match what ledger and configuration give, and are signed."""
