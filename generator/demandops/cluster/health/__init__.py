"""The health of releases, computed from objects of a cluster. Pure."""
