"""What changes in the rendered files."""
