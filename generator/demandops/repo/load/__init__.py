"""A commit is read as configuration and ledger."""
