"""Stage 8: wakes the controllers of the clusters, and follows the state of releases there.

Only this folder knows the Kubernetes API.
"""
