"""Stage 7, where it is kept: decisions become commits in the state repo, durably and in order.

The only folder that knows Git. Trees and commits are written as objects with pygit2, never
through an index or a work tree; GitPython runs the real git for clone, fetch and push.
"""
