"""What the worker does when nobody demands anything, and when."""
