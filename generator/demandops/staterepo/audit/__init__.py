"""The audit: whether commits are signed, and match ledger and configuration."""
