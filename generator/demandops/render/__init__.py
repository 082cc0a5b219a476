"""Stage 5, how it is written: releases become files, as text by path. Never writes them.

Same input, same bytes. Knows the plan and the configuration; nothing of Git.
"""
