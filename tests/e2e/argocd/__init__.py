"""The end-to-end tests with Argo CD."""
