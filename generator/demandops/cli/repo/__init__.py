"""Commands for a whole state repo: lay it down, check, upgrade and verify it."""
