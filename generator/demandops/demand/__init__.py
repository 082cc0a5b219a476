"""Stage 2, the demand: a request as one frozen value, and the claims that it makes.

Requests come from ROS actions and YAML files. This stage knows the configuration, to refuse what
cannot run. It does not know the ledger.
"""
