"""Scenarios in YAML: demands, and what each must cause. ``README.md`` describes their form."""
