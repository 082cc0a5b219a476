"""What must come of demands, told as YAML: see ``README.md``."""
