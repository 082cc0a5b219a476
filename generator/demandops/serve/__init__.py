"""From a submitted demand to its receipt: the process that does the work."""

from demandops.serve.generator import Generator

__all__ = ["Generator"]
