"""Stage 3, what is booked: the set of claims, how requests change it, and how it is written.

Pure: no clock, no disk, no Git. Knows nothing of what runs because of a claim.
"""
