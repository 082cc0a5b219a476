"""Stage 4, what should run: releases derived from claims.

This stage knows the ledger and the configuration, but not Helm, Flux or files.
"""
