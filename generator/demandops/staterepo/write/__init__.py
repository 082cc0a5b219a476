"""What is written: commits, the journal of demands, and the branches of proposals."""
