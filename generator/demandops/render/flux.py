"""Manifests for Flux: a HelmRelease for each service, and the chart sources of each domain.

The fields are those of helm.toolkit.fluxcd.io/v2 and source.toolkit.fluxcd.io/v1 in Flux 2.9.
The manifests do not contain requesters, so a new requester of a running service changes only the
ledger, unless the topics, parameters or replicas of the service change with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from demandops.base.settings import MAIN_BRANCH
from demandops.model.config.config import Config
from demandops.model.config.policy import AccessDomain
from demandops.model.config.registry import ChartSource
from demandops.model.release import ServiceRelease
from demandops.render.bootstrap import node_rule, with_digest
from demandops.render.paths import bootstrap_path, domain_folder, domains_by_cluster, domains_in_use
from demandops.templating import engine


def render(release: ServiceRelease, values: Mapping[str, Any]) -> str:
    chart = release.chart
    return engine.text(
        "flux/release.yaml.j2",
        release=release,
        chart_kind="OCIRepository" if chart.oci else "HelmChart",
        chart_name=chart_object(release.service.chart, chart),
        values=values,
    )


def chart_object(name: str, chart: ChartSource) -> str:
    """Return the name of the OCIRepository or HelmChart that fetches this version of a chart."""
    return f"{name}-{chart.version}".lower()


def base_files(config: Config) -> dict[str, str]:
    """Return the files that do not depend on demands, by path."""
    # without the URL of the repo, there is nothing that a bootstrap file could make Flux follow
    flux = config.repo_settings.flux
    files = {
        bootstrap_path(cluster): _bootstrap(cluster, domains, config)
        for cluster, domains in domains_by_cluster(config).items()
        if flux is not None and flux.url is not None
    }
    for cluster, domain in domains_in_use(config):
        folder = domain_folder(cluster, domain)
        files[f"{folder}/_domain.yaml"] = engine.text(
            "flux/domain.yaml.j2", cluster=cluster, domain=domain
        )
        for name, chart in sorted(config.charts.items()):
            for source in chart.sources():
                object_name = chart_object(name, source)
                files[f"{folder}/_charts/{object_name}.yaml"] = engine.text(
                    "flux/chart.yaml.j2",
                    chart=source,
                    chart_name=name,
                    name=object_name,
                    namespace=domain.namespace,
                    source=config.repo_settings.source,
                )
    return files


def _bootstrap(cluster: str, domains: list[AccessDomain], config: Config) -> str:
    return with_digest(
        lambda digest: engine.text(
            "flux/bootstrap.yaml.j2",
            digest=digest,
            cluster=cluster,
            domains=domains,
            node_rules={domain.name: node_rule(cluster, domain, config) for domain in domains},
            folders={domain.name: domain_folder(cluster, domain) for domain in domains},
            repository=config.repo_settings,
            branch=MAIN_BRANCH,
        )
    )
