"""Where a release stands in the state repo, whichever controller reads it.

Other programs rely on these paths, and so do both controllers: a folder is one access domain's
part of one cluster.
"""

from __future__ import annotations

from generator.catalog.catalog import Catalog
from generator.catalog.policy import AccessDomain
from generator.plan import naming
from generator.plan.release import Release

CLUSTERS_ROOT = "clusters"
BOOTSTRAP_ROOT = "bootstrap"


def domain_folder(cluster: str, domain: AccessDomain) -> str:
    """Return the folder that a controller applies as one."""
    return f"{CLUSTERS_ROOT}/{cluster}/{domain.name}"


def path_of(release: Release) -> str:
    """Return ``clusters/<cluster>/<access domain>/<node>/<release>.yaml``."""
    folder = domain_folder(release.node.cluster, release.domain)
    return f"{folder}/{naming.object_name('', release.node.id)}/{release.name}.yaml"


def bootstrap_path(cluster: str) -> str:
    """Return the path of what makes a cluster follow the repo."""
    return f"{BOOTSTRAP_ROOT}/{cluster}.yaml"


def domains_in_use(catalog: Catalog) -> list[tuple[str, AccessDomain]]:
    """Return every (cluster, access domain) that some node belongs to, sorted."""
    pairs = {
        (node.cluster, catalog.domain_of[node.id].name)
        for node in catalog.nodes.values()
        if node.id in catalog.domain_of
    }
    return [(cluster, catalog.domains[name]) for cluster, name in sorted(pairs)]


def domains_by_cluster(catalog: Catalog) -> dict[str, list[AccessDomain]]:
    """Return the access domains of each cluster that has one."""
    found: dict[str, list[AccessDomain]] = {}
    for cluster, domain in domains_in_use(catalog):
        found.setdefault(cluster, []).append(domain)
    return found
