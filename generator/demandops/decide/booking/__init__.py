"""A request changes the ledger."""
