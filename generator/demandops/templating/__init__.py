"""Charts, templates and values: what authors write and a child process evaluates."""
