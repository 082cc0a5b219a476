"""What the rig raises: one type, whose text says where, what and how to mend it."""


class RigError(RuntimeError):
    """The rig could not build, start or reach something; the text is for a person."""
