"""Flux: one HelmRelease for each service, one chart source for each chart, a folder a domain.

Fields of helm.toolkit.fluxcd.io/v2 and source.toolkit.fluxcd.io/v1 as of Flux 2.9. Requesters do
not appear here: who else asks for a running service changes the ledger and nothing that runs.
"""

from __future__ import annotations

from generator.catalog.catalog import Catalog
from generator.catalog.inventory import Node
from generator.catalog.policy import AccessDomain
from generator.catalog.registry import ChartSource
from generator.plan import naming
from generator.plan.release import Release, ServiceRelease
from generator.render import connections
from generator.render.check import check_values
from generator.render.engine import Engine
from generator.settings import MAIN_BRANCH

CLUSTERS_ROOT = "clusters"
BOOTSTRAP_ROOT = "bootstrap"


def domain_folder(cluster: str, domain: AccessDomain) -> str:
    """Return the folder that one Kustomization applies."""
    return f"{CLUSTERS_ROOT}/{cluster}/{domain.name}"


def path_of(release: Release) -> str:
    """Return ``clusters/<cluster>/<access domain>/<node>/<release>.yaml``."""
    folder = domain_folder(release.node.cluster, release.domain)
    return f"{folder}/{naming.object_name('', release.node.id)}/{release.name}.yaml"


def render(release: Release, catalog: Catalog, engine: Engine) -> str:
    """Return the one file of a release.

    Raises:
        InvalidInput: where an appdef's values template fails or its values break the chart's
            schema.
    """
    if not isinstance(release, ServiceRelease):
        return connections.render(release, catalog, engine)
    template = catalog.values_template(release.appdef, release.service)
    values = engine.data(template, **_context(release, catalog))
    chart = release.chart
    check_values(values, chart, catalog, template)
    return engine.text(
        "flux/release.yaml.j2",
        release=release,
        chart_kind="OCIRepository" if chart.oci else "HelmChart",
        chart_name=chart_object(release.service.chart, chart),
        values=values,
    )


def chart_object(name: str, chart: ChartSource) -> str:
    """Return the name of the object that fetches one chart in one version."""
    return f"{name}-{chart.version}".lower()


def standing_files(catalog: Catalog, engine: Engine) -> dict[str, str]:
    """Return the files that stay when nothing is demanded.

    For each cluster what makes its Flux follow the repo; for each access domain on it the chart
    sources and a placeholder: Git drops empty folders, and a missing folder makes Flux and Argo CD
    fail instead of pruning.
    """
    files = {
        f"{BOOTSTRAP_ROOT}/{cluster}.yaml": _bootstrap(cluster, catalog, engine)
        for cluster in sorted({cluster for cluster, _ in domains_in_use(catalog)})
    }
    for cluster, domain in domains_in_use(catalog):
        folder = domain_folder(cluster, domain)
        files[f"{folder}/_domain.yaml"] = engine.text(
            "flux/domain.yaml.j2", cluster=cluster, domain=domain
        )
        for name, chart in sorted(catalog.charts.items()):
            for source in chart.sources():
                object_name = chart_object(name, source)
                files[f"{folder}/_charts/{object_name}.yaml"] = engine.text(
                    "flux/chart.yaml.j2",
                    chart=source,
                    chart_name=name,
                    name=object_name,
                    namespace=domain.namespace,
                    source=catalog.repository.source,
                )
    return files


def _bootstrap(cluster: str, catalog: Catalog, engine: Engine) -> str:
    domains = [domain for name, domain in domains_in_use(catalog) if name == cluster]
    return engine.text(
        "flux/bootstrap.yaml.j2",
        cluster=cluster,
        domains=domains,
        folders={domain.name: domain_folder(cluster, domain) for domain in domains},
        charts=sorted(
            {
                source.folder
                for chart in catalog.charts.values()
                for source in chart.sources()
                if source.folder
            }
        ),
        repository=catalog.repository,
        branch=MAIN_BRANCH,
    )


def domains_in_use(catalog: Catalog) -> list[tuple[str, AccessDomain]]:
    """Return every (cluster, access domain) that some node belongs to, sorted."""
    pairs = {
        (node.cluster, catalog.domain_of[node.id].name)
        for node in catalog.nodes.values()
        if node.id in catalog.domain_of
    }
    return [(cluster, catalog.domains[name]) for cluster, name in sorted(pairs)]


def _context(release: ServiceRelease, catalog: Catalog) -> dict[str, object]:
    context: dict[str, object] = {
        "release": release.name,
        "service": release.key.service,
        "node": _node(release.node),
        "inputs": {
            role: [
                {"topic": topic.topic, "source": topic.source, "type": topic.type}
                for topic in topics
            ]
            for role, topics in release.inputs.items()
        },
        "outputs": dict(release.outputs),
        "parameters": dict(release.parameters),
        "images": {name: catalog.images[name].parts() for name in release.service.images},
        "replicas": release.replicas,
    }
    if release.key.application is not None:
        return context | {"application": release.key.application}
    return context | {"source": release.key.source, "source_topic": release.key.topic}


def _node(node: Node) -> dict[str, object]:
    return {
        "id": node.id,
        "selector": node.labels(),
        "tolerations": [item.model_dump(exclude_defaults=True) for item in node.tolerations],
        "image_pull_secrets": list(node.image_pull_secrets),
        "host_network": node.host_network,
        "ros": {"domain_id": node.ros.domain_id, "rmw": node.ros.rmw},
    }
