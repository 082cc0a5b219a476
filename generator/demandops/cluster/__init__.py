"""Wakes the controllers of the clusters, and follows the releases on the clusters.

Only this folder knows the Kubernetes API.
"""
