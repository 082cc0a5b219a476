"""What the objects of a cluster say about releases: by Flux's health_reader, or Argo CD's. Pure.

What is asked here is asked of any place; each knows by which controller it is kept, so a state
repo may go over from one to the other while demands are followed.
"""

from __future__ import annotations

from demandops.cluster.health import argocd, flux
from demandops.cluster.health.model import (
    ClusterDomain,
    Health,
    HealthReader,
    History,
    Key,
    Level,
    Object,
    ObjectName,
    Objects,
    ObjectSelector,
    Target,
    worst,
)

__all__ = [
    "ClusterDomain",
    "Health",
    "HealthReader",
    "History",
    "Key",
    "Level",
    "Object",
    "ObjectName",
    "ObjectSelector",
    "Objects",
    "Target",
    "health_reader",
    "worst",
]


def health_reader(domain: ClusterDomain) -> HealthReader:
    """Return how the objects of a place are read."""
    return argocd if domain.application else flux
