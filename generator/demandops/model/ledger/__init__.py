"""What is booked: the ledger's files and the ledger as a whole."""
