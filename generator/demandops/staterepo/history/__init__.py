"""The history: messages and authors of commits, and the commits that changed a path."""
