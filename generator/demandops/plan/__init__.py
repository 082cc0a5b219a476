"""Stage 4, what should run: releases derived from claims, for what a demand affects only.

Knows the ledger and the configuration; nothing of Helm, Flux or files.
"""
