"""Commands that change the ledger: request, import, decommission, rollback."""
