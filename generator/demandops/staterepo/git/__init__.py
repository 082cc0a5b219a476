"""Git: trees, signed commits, and the repository on this disk or behind a URL."""
