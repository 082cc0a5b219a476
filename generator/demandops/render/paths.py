"""The paths of generated files, the same for both controllers.

Other programs rely on these paths. There is one folder for each access domain of each cluster.
"""

from __future__ import annotations

from demandops.base import naming
from demandops.model.config.config import Config
from demandops.model.config.policy import AccessDomain
from demandops.model.release import Release

CLUSTERS_ROOT = "clusters"
BOOTSTRAP_ROOT = "bootstrap"


def domain_folder(cluster: str, domain: AccessDomain) -> str:
    """Return the folder of an access domain in a cluster. A controller applies the whole folder."""
    return f"{CLUSTERS_ROOT}/{cluster}/{domain.name}"


def path_of(release: Release) -> str:
    # clusters/<cluster>/<access domain>/<node>/<release>.yaml
    folder = domain_folder(release.node.cluster, release.domain)
    return f"{folder}/{naming.object_name('', release.node.id)}/{release.name}.yaml"


def bootstrap_path(cluster: str) -> str:
    return f"{BOOTSTRAP_ROOT}/{cluster}.yaml"


def domains_in_use(config: Config) -> list[tuple[str, AccessDomain]]:
    """Return (cluster, access domain) for each domain with nodes in the cluster, sorted."""
    pairs = {
        (node.cluster, config.domain_of[node.id].name)
        for node in config.nodes.values()
        if node.id in config.domain_of
    }
    return [(cluster, config.domains[name]) for cluster, name in sorted(pairs)]


def domains_by_cluster(config: Config) -> dict[str, list[AccessDomain]]:
    """Return the access domains that have nodes in a cluster, for each cluster that has any."""
    domains: dict[str, list[AccessDomain]] = {}
    for cluster, domain in domains_in_use(config):
        domains.setdefault(cluster, []).append(domain)
    return domains
