"""Stage 5: turns releases into the paths and texts of files, without writing any file.

The same input gives the same bytes. This stage knows the plan and the configuration, but not Git.
"""
