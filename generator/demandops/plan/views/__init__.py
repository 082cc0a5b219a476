"""Views for people: who requests what, why a release runs, and what an override does."""
