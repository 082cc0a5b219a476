"""The files that Flux or Argo CD follows: where they are, and what is in them."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput
from demandops.base.settings import MAIN_BRANCH
from demandops.model.config.config import Config
from demandops.model.config.inventory import NODE_LABEL
from demandops.model.config.policy import AccessDomain
from demandops.model.config.registry import ChartSource
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.release import Release, ServiceRelease
from demandops.templating import engine

# ---- the paths of generated files, the same for both controllers ----
#
# Other programs rely on these paths. There is one folder for each access domain of each cluster.

CLUSTERS_ROOT = "clusters"
BOOTSTRAP_ROOT = "bootstrap"


def domain_folder(cluster: str, domain: AccessDomain) -> str:
    # A controller applies the whole folder.
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
    domains: dict[str, list[AccessDomain]] = {}
    for cluster, domain in domains_in_use(config):
        domains.setdefault(cluster, []).append(domain)
    return domains


# ---- the rule by which a cluster lets pods of an access domain run only on the domain's nodes ----
#
# The rule is an expression of the Common Expression Language. Its variable ``variables.selector``
# is a pod's node selector. For nodes with the default selector, the rule contains the patterns of
# the policy instead of the nodes' names. So a new vehicle with this selector does not change the
# rule, and no person has to apply the rule again.

_SELECTOR = "variables.selector"


def node_rule(cluster: str, domain: AccessDomain, config: Config) -> str:
    """Return the expression that is true for the selectors of the domain's nodes."""
    by_label: dict[str, set[str]] = {}
    selectors: set[tuple[tuple[str, str], ...]] = set()
    for node in config.nodes.values():
        if node.selector is None or node.cluster != cluster:
            continue
        if config.domain_of.get(node.id) is not domain:
            continue
        if len(node.selector) == 1:
            ((label, value),) = node.selector.items()
            by_label.setdefault(label, set()).add(value)
        else:
            selectors.add(tuple(sorted(node.selector.items())))
    pattern = "|".join(map(expression_of, domain.nodes))
    parts = [_has(NODE_LABEL, f".matches({_text(f'^({pattern})$')})")]
    parts += [
        _has(label, f" in [{', '.join(map(_text, sorted(values)))}]")
        for label, values in sorted(by_label.items())
    ]
    for selector in sorted(selectors):
        labels = " && ".join(_has(label, f" == {_text(value)}") for label, value in selector)
        parts.append(f"({labels or 'true'})")  # a node with ``selector: {}`` takes every pod
    return " || ".join(parts)


def expression_of(pattern: str) -> str:
    # a pattern of the policy as a regular expression of RE2
    return "".join({"*": ".*", "?": "."}.get(char, re.escape(char)) for char in pattern)


def _has(label: str, test: str) -> str:
    return f"({_text(label)} in {_SELECTOR} && {_SELECTOR}[{_text(label)}]{test})"


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)  # a JSON string is also a CEL string


# ---- the digest of a bootstrap file, which shows which version of the file a cluster has ----
#
# A person applies the file, so the cluster may have an older version of it. The object that applies
# an access domain's folder has the digest of the applied file as an annotation. ``demandops
# status`` compares this digest with that of the file in the state repo.

ANNOTATION = "demandops/bootstrap"
_LENGTH = 16


def _bootstrap(
    template: str, cluster: str, domains: list[AccessDomain], config: Config, **more: object
) -> str:
    """Return the text of a bootstrap file that contains its own digest."""

    def render(digest: str) -> str:
        return engine.text(
            template,
            digest=digest,
            cluster=cluster,
            domains=domains,
            node_rules={domain.name: node_rule(cluster, domain, config) for domain in domains},
            folders={domain.name: domain_folder(cluster, domain) for domain in domains},
            repository=config.repo_settings,
            branch=MAIN_BRANCH,
            **more,
        )

    return render(_digest(render("")))  # the digest covers neither itself nor comments


@lru_cache(maxsize=256)  # most changes of a configuration leave the bootstrap files as they are
def _digest(text: str) -> str:
    objects = json.dumps(list(strict_yaml.load_all(text)), sort_keys=True)
    return hashlib.sha256(objects.encode()).hexdigest()[:_LENGTH]


def digest_of(item: Mapping[str, Any]) -> str:
    annotations = (item.get("metadata") or {}).get("annotations") or {}
    return str(annotations.get(ANNOTATION, ""))


@lru_cache(maxsize=1024)  # the web page asks for the same files repeatedly
def digest_in(text: str) -> str:
    try:
        items = list(strict_yaml.load_all(text))
    except InvalidInput:
        return ""
    return next(filter(None, (digest_of(item) for item in items if isinstance(item, dict))), "")


# ---- manifests for Flux: a HelmRelease for each service, and the chart sources of each domain ----
#
# The fields are those of helm.toolkit.fluxcd.io/v2 and source.toolkit.fluxcd.io/v1 in Flux 2.9. The
# manifests do not contain requesters, so a new requester of a running service changes only the
# ledger, unless the topics, parameters or replicas of the service change with it.


def flux_manifests(release: ServiceRelease, values: Mapping[str, Any]) -> str:
    chart = release.chart
    return engine.text(
        "flux/release.yaml.j2",
        release=release,
        chart_kind="OCIRepository" if chart.oci else "HelmChart",
        chart_name=chart_object(release.service.chart, chart),
        values=values,
    )


def chart_object(name: str, chart: ChartSource) -> str:
    # the OCIRepository or HelmChart that fetches this version of a chart
    return f"{name}-{chart.version}".lower()


def flux_base_files(config: Config) -> dict[str, str]:
    # without the URL of the repo, there is nothing that a bootstrap file could make Flux follow
    flux = config.repo_settings.flux
    files = {
        bootstrap_path(cluster): _bootstrap("flux/bootstrap.yaml.j2", cluster, domains, config)
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


# ---- manifests for Argo CD: an Application for each service and for each domain's folder ----
#
# The fields are those of argoproj.io/v1alpha1 in Argo CD 3.2. Each cluster has its own Argo CD. The
# Applications of services are in the access domain's namespace. If they were in Argo CD's own
# namespace, they could name another domain's project (docs/decisions/0011).

# The address by which Argo CD reaches the cluster that it runs in
IN_CLUSTER = "https://kubernetes.default.svc"


def project_of(domain: AccessDomain, repository: RepoSettings) -> str:
    # the domain's AppProject, and the Application of the domain's folder
    return f"{repository.source}-{domain.name}"


def argocd_manifests(
    release: ServiceRelease, values: Mapping[str, Any], repository: RepoSettings
) -> str:
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


def argocd_base_files(config: Config) -> dict[str, str]:
    section = config.repo_settings.argocd
    assert section is not None  # noqa: S101 - required when gitops is "argocd"
    # Applications may fetch only from these: the state repo and the charts' repositories
    charts = {
        source.oci or source.http for chart in config.charts.values() for source in chart.sources()
    }
    urls = [section.url, *sorted(url for url in charts if url and url != section.url)]
    files = {
        bootstrap_path(cluster): _bootstrap(
            "argocd/bootstrap.yaml.j2",
            cluster,
            domains,
            config,
            projects={domain.name: project_of(domain, config.repo_settings) for domain in domains},
            urls=urls,
            server=IN_CLUSTER,
        )
        for cluster, domains in domains_by_cluster(config).items()
    }
    for cluster, domain in domains_in_use(config):
        files[f"{domain_folder(cluster, domain)}/_domain.yaml"] = engine.text(
            "argocd/domain.yaml.j2", cluster=cluster, domain=domain
        )
    return files
