"""Commands that change the ledger: request, decommission, rollback."""
