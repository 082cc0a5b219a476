"""Evaluates what people wrote in a process with limits, which can be killed."""
