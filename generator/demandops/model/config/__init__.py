"""What people write: inventory, appdefs, registry, policy, overrides, settings."""
