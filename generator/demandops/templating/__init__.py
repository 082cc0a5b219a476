"""Strict templates and schemas: what turns text that people wrote into the values of a chart.

This room imports neither the configuration nor pydantic, because it also runs in a process that
must start quickly (:mod:`demandops.evaluator`).
"""
