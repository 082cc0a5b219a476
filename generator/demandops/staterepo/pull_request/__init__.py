"""A checked-out state repo, as a person is about to merge it."""
