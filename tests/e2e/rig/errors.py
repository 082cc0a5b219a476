"""The exception of the rig; its message says where the fault is, what it is and how to mend it."""


class RigError(RuntimeError):
    """Raised when the rig cannot build, start or reach something."""
