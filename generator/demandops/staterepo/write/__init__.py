"""Writing: the commits of a batch, the journal of demands, and the branches of proposals."""
