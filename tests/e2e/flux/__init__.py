"""The end-to-end tests with Flux."""
