"""Stage 4, what should run: releases derived from claims.

Knows the ledger and the configuration, but not Helm, Flux or files.
"""
