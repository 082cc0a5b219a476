"""What differs between two states of the rendered files."""
