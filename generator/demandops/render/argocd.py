"""Manifests for Argo CD: an Application for each service and for each access domain's folder.

The fields are those of argoproj.io/v1alpha1 in Argo CD 3.2. Each cluster has its own Argo CD. The
Applications of services are in the access domain's namespace. If they were in Argo CD's own
namespace, they could name another domain's project (docs/decisions/0011).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from demandops.base.settings import MAIN_BRANCH
from demandops.model.config.config import Config
from demandops.model.config.policy import AccessDomain
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.release import ServiceRelease
from demandops.render.bootstrap import node_rule, with_digest
from demandops.render.paths import bootstrap_path, domain_folder, domains_by_cluster, domains_in_use
from demandops.templating import engine

# The address by which Argo CD reaches the cluster that it runs in
IN_CLUSTER = "https://kubernetes.default.svc"


def project_of(domain: AccessDomain, repository: RepoSettings) -> str:
    """Return the name of a domain's AppProject, and of the Application of the domain's folder."""
    return f"{repository.source}-{domain.name}"


def render(release: ServiceRelease, values: Mapping[str, Any], repository: RepoSettings) -> str:
    return engine.text(
        "argocd/release.yaml.j2",
        release=release,
        chart=release.chart,
        values=values,
        project=project_of(release.domain, repository),
        repository=repository,
        branch=MAIN_BRANCH,
        server=IN_CLUSTER,
    )


def base_files(config: Config) -> dict[str, str]:
    """Return the bootstrap files and a placeholder for each access domain of a cluster, by path."""
    files = {
        bootstrap_path(cluster): _bootstrap(cluster, domains, config)
        for cluster, domains in domains_by_cluster(config).items()
    }
    for cluster, domain in domains_in_use(config):
        files[f"{domain_folder(cluster, domain)}/_domain.yaml"] = engine.text(
            "argocd/domain.yaml.j2", cluster=cluster, domain=domain
        )
    return files


def _bootstrap(cluster: str, domains: list[AccessDomain], config: Config) -> str:
    section = config.repo_settings.argocd
    assert section is not None  # noqa: S101 - required when gitops is "argocd"
    # Applications may fetch only from these: the state repo and the charts' repositories
    charts = {
        source.oci or source.http for chart in config.charts.values() for source in chart.sources()
    }
    urls = [section.url, *sorted(url for url in charts if url and url != section.url)]
    return with_digest(
        lambda digest: engine.text(
            "argocd/bootstrap.yaml.j2",
            digest=digest,
            cluster=cluster,
            domains=domains,
            node_rules={domain.name: node_rule(cluster, domain, config) for domain in domains},
            folders={domain.name: domain_folder(cluster, domain) for domain in domains},
            projects={domain.name: project_of(domain, config.repo_settings) for domain in domains},
            urls=urls,
            repository=config.repo_settings,
            branch=MAIN_BRANCH,
            server=IN_CLUSTER,
        )
    )
