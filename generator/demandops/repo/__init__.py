"""The state repo. Nothing else knows Git."""
