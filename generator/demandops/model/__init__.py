"""The nouns: what people write, what is demanded, what is booked, what a release is."""
