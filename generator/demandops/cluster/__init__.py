"""Kubernetes. Nothing else knows it."""
