"""What everything stands on: errors, strict YAML, names, time and threads, HTTP."""
