"""What of the experiment a run of it does not show."""
