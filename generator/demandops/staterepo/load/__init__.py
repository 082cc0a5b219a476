"""Loading a commit: configuration, ledger, and what stays in effect while a file is invalid."""
