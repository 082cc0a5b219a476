"""The exception of the rig; its text says where, what and the remedy."""


class RigError(RuntimeError):
    """Raised when the rig cannot build, start or reach something."""
