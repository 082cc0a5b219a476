"""A real cluster on loopback, without containers, for the end-to-end tests.

`tools` builds the programs, `cluster.Rig` starts them and is all that a test needs. This module
imports nothing, so that a Python without packages can build the programs.
"""


class RigError(RuntimeError):
    """Raised when the rig cannot build, start or reach something; it says how to mend it."""
