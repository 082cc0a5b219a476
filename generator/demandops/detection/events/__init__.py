"""The engine: from observations to events."""
