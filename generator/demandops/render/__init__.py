"""Releases as text for Flux and Argo CD."""
