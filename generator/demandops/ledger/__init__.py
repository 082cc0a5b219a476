"""Stage 3, what is booked: the set of claims, the operations on it, and its files.

Pure: no clock, no disk, no Git. Does not know what runs because of a claim.
"""
