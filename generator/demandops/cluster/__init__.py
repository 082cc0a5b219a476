"""Stage 8, what came of it: the clusters that follow the state repo. The only folder that knows
the Kubernetes API.
"""
