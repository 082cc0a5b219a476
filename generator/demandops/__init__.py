"""DemandOps turns demands of connected vehicles into desired state in Git.

Data flows through the stages in this order: config → demand → ledger → plan → render → decision →
staterepo → service → cli. ``ARCHITECTURE.md`` describes them and the other folders.
"""

__all__ = ["__version__"]

__version__ = "1.0.0"
