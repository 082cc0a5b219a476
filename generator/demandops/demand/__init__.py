"""Stage 2, what is asked: a request, from whichever wire, as one frozen value, and what it claims.

Knows the configuration (to refuse what cannot be run) and nothing of what is booked already.
"""
