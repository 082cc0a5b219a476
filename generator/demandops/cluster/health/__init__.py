"""What the objects of a cluster say about releases: by Flux's reading, or Argo CD's. Pure.

What is asked here is asked of any place; each knows by which controller it is kept, so a state
repo may go over from one to the other while demands are followed.
"""

from __future__ import annotations

from demandops.cluster.health import argocd, flux
from demandops.cluster.health.model import (
    Health,
    History,
    Key,
    Level,
    Named,
    Object,
    Objects,
    Place,
    Reading,
    Target,
    Watched,
    worst,
)

__all__ = [
    "Health",
    "History",
    "Key",
    "Level",
    "Named",
    "Object",
    "Objects",
    "Place",
    "Reading",
    "Target",
    "Watched",
    "reading",
    "worst",
]


def reading(place: Place) -> Reading:
    """Return how the objects of a place are read."""
    return argocd if place.application else flux
