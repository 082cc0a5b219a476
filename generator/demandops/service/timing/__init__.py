"""When something is due: fetches, retries, ends of leases and overrides, and rate limits."""
