"""The releases that claims and overrides ask for."""
