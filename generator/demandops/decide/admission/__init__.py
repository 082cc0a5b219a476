"""A goal becomes a request that policy allows, with what it left open."""
