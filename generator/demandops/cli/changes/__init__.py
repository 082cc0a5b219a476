"""Commands that write to the state repo: bookings, approvals and overrides."""
