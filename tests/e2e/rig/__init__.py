"""A real cluster on loopback, without containers, for the end-to-end tests.

`tools` builds the programs, `cluster.Rig` starts them and is all that a test needs. This module
imports nothing, so that a Python without packages can build the programs.
"""


class RigError(RuntimeError):
    """Raised when the rig cannot build, start or reach something; it says how to mend it."""


ENDS_WITH_US = ("setpriv", "--pdeathsig", "KILL")
"""Before a command: the kernel kills the program when the process that started it has ended.

Else a test run that is ended by `kill -9` would leave a cluster behind.
"""
