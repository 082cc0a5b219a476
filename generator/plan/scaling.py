"""How many replicas a service has, from how many topics it takes in."""

from __future__ import annotations

from generator.catalog.appdef import Scaling


def replicas(scaling: Scaling, topics: int) -> int:
    """Return the replicas for ``topics`` inputs, within the appdef's bounds."""
    if scaling.topics_per_replica is None:
        return scaling.min
    wanted = -(-topics // scaling.topics_per_replica)
    return max(scaling.min, min(scaling.max, wanted))
