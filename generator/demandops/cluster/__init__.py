"""Stage 8: the clusters that follow the state repo.

The only folder that knows the Kubernetes API.
"""
