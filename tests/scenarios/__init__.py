"""Scenarios in YAML: demands, and the effects that each must have. ``README.md`` has their form."""
