"""Stage 3, what is booked: the set of claims, the operations on it, and its files.

This stage is pure: it uses no clock, no disk and no Git. It does not know what runs because of a
claim.
"""
