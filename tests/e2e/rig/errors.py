"""The exception of the rig; its text names the place, the fault and the remedy."""


class RigError(RuntimeError):
    """Raised when the rig cannot build, start or reach something."""
