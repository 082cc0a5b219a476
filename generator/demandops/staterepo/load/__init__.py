"""A commit's configuration and ledger, and what stays in force while a file is not valid."""
