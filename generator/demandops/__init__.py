"""DemandOps turns demands of connected vehicles into desired state in Git.

Each folder is a stage. Data flows through them in this order: config → demand → ledger → plan →
render → decision → staterepo → service → cli. ``docs/architecture.md`` describes each stage.
"""

__all__ = ["__version__"]

__version__ = "0.1.0"
