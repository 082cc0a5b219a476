"""Stage 7, the state repo: decisions become commits, durably and in order.

Only this folder uses Git. It writes trees and commits as objects with pygit2, never through an
index or a work tree. GitPython runs the git program to clone, fetch and push.
"""
