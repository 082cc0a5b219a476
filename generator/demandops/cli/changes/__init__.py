"""Commands that write to the state repo: bookings, and what people commit."""
