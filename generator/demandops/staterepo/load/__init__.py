"""Loading a commit: its configuration and ledger, and last valid versions of invalid files."""
