"""The health of releases, computed from a cluster's objects. Pure.

Flux and Argo CD each have a reader. Every :class:`ClusterDomain` knows its controller, so a state
repo may switch controllers while rollouts are followed.
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
    """Return the reader for the controller of a domain."""
    return argocd if domain.application else flux
