"""Stage 4, what should run: the releases that the planner derives from claims.

This stage uses the ledger and the configuration. It does not use Helm, Flux or files.
"""
