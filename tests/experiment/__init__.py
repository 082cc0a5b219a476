"""The paper's experiment with the event detector in place of scripted demands.

`make experiment` runs it; see docs/experiment.md.
"""
