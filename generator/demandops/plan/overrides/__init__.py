"""What overrides make of claims and releases, before anything is planned."""
