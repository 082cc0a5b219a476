"""What refuses a booking by its plan: quotas and denials; and trials of what people merge."""
