"""The paper's experiment with the event detector in place of scripted demands.

`make experiment` runs it; see README.md beside it.
"""
