"""Stage 5: turns releases into the text of files, by path. It writes no file.

The same input gives the same bytes. This stage knows the plan and the configuration, but not Git.
"""
