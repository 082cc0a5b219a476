"""What each operation does to the ledger, one module each, and what they share."""
