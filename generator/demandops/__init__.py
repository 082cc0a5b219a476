"""DemandOps: from a demand of a connected vehicle to desired state in Git.

The folders are the stages, in the order that data takes: config → demand → ledger → plan →
render → decision → staterepo → service → cli. ``docs/architecture.md`` has one paragraph for each.
"""

__all__ = ["__version__"]

__version__ = "0.1.0"
