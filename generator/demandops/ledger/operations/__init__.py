"""The operations on the ledger, one module each, and the rules that they share."""
