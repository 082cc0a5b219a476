"""When something is due: fetches, retries, leases, overrides, and rate limits."""
