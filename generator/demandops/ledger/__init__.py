"""Stage 3, what is booked: the set of claims, the operations on it, and its files.

Pure: no clock, no disk, no Git. This stage does not know what runs because of a claim.
"""
