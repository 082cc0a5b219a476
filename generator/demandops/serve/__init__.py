"""The running generator: from a submitted demand to its receipt."""
