"""The operations on the ledger, one module for each, and the rules that the operations share."""
