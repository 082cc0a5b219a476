"""Stage 8: the clusters that follow the state repo.

Only this folder knows the Kubernetes API.
"""
