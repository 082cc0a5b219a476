"""The health of releases, computed from a cluster's objects. Pure.

Flux and Argo CD each have a reader. The reader is chosen for each :class:`ClusterDomain`, so a
state repo may switch from one controller to the other while rollouts are followed.
"""

from __future__ import annotations

from demandops.cluster.health.argocd import ArgoCd
from demandops.cluster.health.flux import Flux
from demandops.cluster.health.release_health import ClusterDomain, HealthReader

_ARGOCD, _FLUX = ArgoCd(), Flux()


def health_reader(domain: ClusterDomain) -> HealthReader:
    return _ARGOCD if domain.application else _FLUX
