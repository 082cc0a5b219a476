"""Views for people: who requests what, why a release runs, what an override does."""
