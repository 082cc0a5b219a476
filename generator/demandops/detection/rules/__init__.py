"""The rules that people write, and what they demand."""
