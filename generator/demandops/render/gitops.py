"""The files that Flux or Argo CD follows: where they are, and what is in them."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from itertools import dropwhile, takewhile
from typing import Any

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput, Refused
from demandops.base.placeholders import any_value_of, is_pattern
from demandops.base.settings import MAIN_BRANCH
from demandops.connections.connection import UNSUPPORTED
from demandops.model.config.config import IMAGES_FILE, Config
from demandops.model.config.inventory import NODE_LABEL
from demandops.model.config.override import format_time
from demandops.model.config.policy import AccessDomain
from demandops.model.config.registry import ChartSource
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.ledger.ledger import World
from demandops.model.release import Release, ServiceRelease
from demandops.templating import engine
from demandops.templating.values import Evaluate, ValuesTask

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


def domains_by_cluster(config: Config) -> dict[str, list[AccessDomain]]:
    """Return the access domains with nodes in each cluster, sorted."""
    pairs = {
        (cluster, domain.name)
        for node in config.kinds.values()
        for cluster, domain in config.places_of(node)
    }
    domains: dict[str, list[AccessDomain]] = {}
    for cluster, name in sorted(pairs):
        domains.setdefault(cluster, []).append(config.domains[name])
    return domains


# ---- the file of a release: comment lines that name the overrides, then its manifests ----
#
# A ``hold`` override keeps the body of a file byte for byte. Only the comments above the body may
# change. These comments still name the overrides that shaped the body when the hold started.

_START = "# override overrides/"
# these effects change only a release's comments, which are updated even in a held file
_OUTSIDE_BODY = frozenset({"hold", "keep"})
_UPDATED_COMMENT = re.compile(rf"{_START}[^:]+: (\w+, )*(hold|keep)(, \w+)*; ")
_CHART = re.compile(rf"{CLUSTERS_ROOT}/[^/]+/[^/]+/_charts/[^/]+\.yaml")


def release_text(release: Release, config: Config, evaluate: Evaluate, current: str | None) -> str:
    outside, of_body = list[str](), list[str]()
    for each, effects in release.shaping.by:
        until = f"until {format_time(each.end)}; " if each.end else ""
        is_outside = release.shaping.held and _OUTSIDE_BODY & {*effects}
        (outside if is_outside else of_body).append(
            f"# override {each.path}: {', '.join(effects)}; priority {each.priority}; {until}"
            f"owner {each.owner}; reason: {each.reason}"
        )
    if current is None or not release.shaping.held:
        comments, body = [*outside, *of_body], render(release, config, evaluate)
    else:
        lines = current.splitlines(keepends=True)
        body = "".join(dropwhile(lambda line: line.startswith(_START), lines))
        # overrides that shaped the body may have ended since the hold started; their comments stay
        above = takewhile(lambda line: line.startswith(_START), lines)
        comments = [*outside, *(c.rstrip("\n") for c in above if not _UPDATED_COMMENT.match(c))]
    return "".join(f"{comment}\n" for comment in comments) + body


_VALUES = re.compile(r"(?m)^( +)values(?:Object)?:\n((?:\1 +.*\n|\n)+)")


def values_apart(text: str) -> tuple[dict[str, str], str]:
    """Return the texts of a release's Helm values by name, and its manifests without them."""
    # Parsing would take longer than all else about a demand, and the text is one that `render` made
    manifests = "".join(line for line in text.splitlines(True) if not line.startswith(_START))
    if (match := _VALUES.search(manifests)) is None:
        return {}, manifests
    parts = re.split(rf"(?m)^{match[1]}  (?=\S)", match[2])[1:]
    values = {name: value for name, _, value in (part.partition(":") for part in parts)}
    return values, manifests[: match.start(2)] + manifests[match.end(2) :]


def render(release: Release, config: Config, evaluate: Evaluate) -> str:
    """Return the manifests of a release as text; raise Refused or InvalidInput if not possible.

    Helm values and the plain manifests of connections are the same for Flux and Argo CD.
    """
    if isinstance(release, ServiceRelease):
        values, chart = values_of(release, config, evaluate), release.chart
        repository = config.repo_settings
        return engine.text(
            f"{repository.gitops}/release.yaml.j2",
            release=release,
            chart=chart,
            chart_kind="OCIRepository" if chart.oci else "HelmChart",
            chart_name=chart_object(release.service.chart, chart),
            values=values,
            project=project_of(release.domain, repository),
            repository=repository,
            branch=MAIN_BRANCH,
            server=IN_CLUSTER,
        )
    # The file of a client: a Deployment, and a ConfigMap with its configuration. Each type of
    # connection has a template and a schema in ``templates/connections/<type>/``. The schema lists
    # the fields that the client's program reads; tests compare configurations with it.
    kind, node = release.type, release.node
    if kind.image not in config.images:
        message = (
            f"'{kind.image}' is in use, but not in {config.place_of(IMAGES_FILE)}; add it there"
        )
        raise Refused.at("images", message, code=UNSUPPORTED)
    configuration, settings = release.configuration(), release.settings(config)
    # A client reads these fields only at its start. Their checksum is an annotation of the pod, so
    # that a change of them restarts the pod, and a change of other fields does not.
    at_start = {name: configuration[name] for name in configuration if name not in release.reread}
    return engine.text(
        f"connections/{kind.word}/client.yaml.j2",
        client=release,
        configuration=release.written(configuration),
        checksum=hashlib.sha256(release.written(at_start).encode()).hexdigest(),
        node=node,
        selector=node.labels,
        tolerations=[item.model_dump(exclude_defaults=True) for item in node.tolerations],
        settings=settings,
        env=release.environment(settings) | settings.env,
        probes={
            f"{name}Probe": probe
            for name in ("startup", "readiness", "liveness")
            if (probe := getattr(settings, f"{name}_probe"))
        },
        resources=settings.resources.model_dump(),
        host_network=node.host_network if settings.host_network is None else settings.host_network,
        image=release.shaping.image(kind.image, config.images[kind.image]).reference(),
    )


# ---- the Helm values of a service: what its template renders to, checked against the chart ----
#
# The variables that the template gets are the interface of application definitions
# (docs/appdef.md). Requesters are not among these variables.


def values_of(release: ServiceRelease, config: Config, evaluate: Evaluate) -> dict[str, Any]:
    """Return the Helm values of a service, with the patches of overrides merged in.

    InvalidInput names the template, the schema or the override at fault.
    """
    template = release.service.values
    if release.autoscaler and release.autoscaler.max == 0:
        by = [each.path for each, effects in release.shaping.by if "replicas" in effects]
        # seen on a cluster: the 0 stayed when the override ended, as no autoscaler starts from 0
        message = (
            "is 0, but an autoscaler keeps at least one replica; to run none, use 'deny' instead"
        )
        raise InvalidInput.at("replicas", message, file=by[-1])
    node = release.node
    variables: dict[str, Any] = {
        "release": release.name,
        "service": release.key.service,
        "node": {
            "id": node.id,
            "selector": node.labels,
            "tolerations": [item.model_dump(exclude_defaults=True) for item in node.tolerations],
            "image_pull_secrets": list(node.image_pull_secrets),
            "host_network": node.host_network,
            "ros": {
                "domain_id": node.ros.domain_id,
                "rmw": "" if node.ros.rmw == "image" else node.ros.rmw,
            },
        },
        "inputs": {
            role: [
                {"topic": topic.topic, "source": topic.source, "type": topic.type}
                for topic in topics
            ]
            for role, topics in release.inputs.items()
        },
        "topics": {
            role: list(dict.fromkeys(topic.topic for topic in topics))
            for role, topics in release.inputs.items()
        },
        "outputs": dict(release.outputs),
        "parameters": dict(release.parameters),
        "requests": release.service.pod_requests,
        "images": {
            name: {part: value or "" for part, value in release.image(name, config)}
            for name in release.service.images
        },
    }
    # Never both. A template that knows only ``replicas`` must fail, because the GitOps controller
    # would set back what the autoscaler writes.
    if scaler := release.autoscaler:
        targets = {str(name): percent for name, percent in scaler.targets.items()}
        variables["autoscaler"] = {"min": scaler.min, "max": scaler.max, **targets}
    else:
        variables["replicas"] = release.replicas
    if release.key.application is not None:
        variables["application"] = release.key.application
    elif release.key.source is not None:
        variables |= {"source": release.key.source, "source_topic": release.key.topic}
    patches = tuple(release.shaping.patches)
    task = ValuesTask(template, variables, release.chart.folder, patches, variables["requests"])
    try:
        return evaluate(config.files, task)
    except InvalidInput as error:
        changing = {"version", "images", "replicas", "node"}
        files = [override.path for override, effects in release.shaping.by if changing & {*effects}]
        if not files:
            raise
        note = f" (overrides change what the template gets, so check {' and '.join(files)} too)"
        faults = (
            replace(fault, message=fault.message + note) if fault.file == template else fault
            for fault in error.faults
        )
        raise type(error)(faults) from None


def kept_charts(
    files: Mapping[str, str], current: Mapping[str, str], world: World
) -> dict[str, str]:
    """Return the chart sources in ``current`` that stay for releases that are held."""
    if not any(override.hold for override in world.overrides):
        return {}
    # not that of a chart in a folder of the state repo: it would fetch the folder's newest version
    return {
        path: text
        for path, text in current.items()
        if _CHART.fullmatch(path) and path not in files and "kind: GitRepository" not in text
    }


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
    by_pattern = list[str]()
    for node in config.kinds.values():
        if node.selector is None or (cluster, domain) not in config.places_of(node):
            continue
        if is_pattern(node.id):
            data = config.node_patterns[node.id.partition("@")[0]].data
            written = (data.get("selector") or node.selector).items()
            tests = [_has(k, f".matches({_text(f'^{any_value_of(v)}$')})") for k, v in written]
            by_pattern.append(f"({' && '.join(tests) or 'true'})")
        elif len(node.selector) == 1:
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
    return " || ".join((*parts, *sorted(by_pattern)))


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


def chart_object(name: str, chart: ChartSource) -> str:
    # the OCIRepository or HelmChart that fetches this version of a chart
    return f"{name}-{chart.version}".lower()


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


# ---- the other files: of domains and clusters, and chart sources ----


def base_files(config: Config) -> dict[str, str]:
    repository, gitops = config.repo_settings, config.repo_settings.gitops
    source = repository.argocd if gitops == "argocd" else repository.flux
    # Applications may fetch only from these: the state repo and the charts' repositories
    charts = (chart for listed in config.charts.values() for chart in listed.sources())
    fetched = {chart.oci or chart.http for chart in charts} - {None, source and source.url}
    projects = {domain.name: project_of(domain, repository) for domain in config.domains.values()}
    files: dict[str, str] = {}
    for cluster, domains in domains_by_cluster(config).items():
        for domain in domains:
            folder = domain_folder(cluster, domain)
            # A placeholder, because Git keeps no empty folder. Without the folder, Flux and Argo CD
            # would fail instead of removing what is not demanded.
            files[f"{folder}/_domain.yaml"] = engine.text(
                f"{gitops}/domain.yaml.j2", cluster=cluster, domain=domain
            )
            for name, chart in sorted(config.charts.items()) if gitops == "flux" else ():
                for version in chart.sources():
                    object_name = chart_object(name, version)
                    files[f"{folder}/_charts/{object_name}.yaml"] = engine.text(
                        "flux/chart.yaml.j2",
                        chart=version,
                        chart_name=name,
                        name=object_name,
                        namespace=domain.namespace,
                        source=repository.source,
                    )
        # without the URL of the repo, there is nothing that a bootstrap file could make Flux follow
        if source is None or source.url is None:
            continue
        bootstrap = partial(
            engine.text,
            f"{gitops}/bootstrap.yaml.j2",
            cluster=cluster,
            domains=domains,
            node_rules={domain.name: node_rule(cluster, domain, config) for domain in domains},
            folders={domain.name: domain_folder(cluster, domain) for domain in domains},
            repository=repository,
            branch=MAIN_BRANCH,
            projects=projects,
            urls=[source.url, *sorted(filter(None, fetched))],
            server=IN_CLUSTER,
        )
        # the file contains its own digest, which covers neither itself nor comments
        files[bootstrap_path(cluster)] = bootstrap(digest=_digest(bootstrap(digest="")))
    return files
