"""Checks across files and entries: an unknown cluster, a prefix that is used twice.

They run when all files are parsed. Every check runs, and the reader collects all faults.
"""

from __future__ import annotations

from demandops import strict_yaml
from demandops.config.appdef import Service
from demandops.config.config import (
    BROKERS_FILE,
    CHARTS_FILE,
    CLUSTERS_FILE,
    DOMAINS_FILE,
    IMAGES_FILE,
    NODES_FILE,
    Config,
)
from demandops.config.config_reader import ConfigReader
from demandops.config.override import Override
from demandops.config.override_conflict import check_override_conflicts
from demandops.config.policy import matches
from demandops.config.registry import ChartSource
from demandops.connections import connection_types
from demandops.errors import InvalidInput, suggestion


def cross_check(config: Config, reader: ConfigReader) -> None:
    """Add every fault across files or entries to the reader."""
    for check in (
        _check_inventory,
        _check_topics,
        _check_namespaces,
        _check_controllers_namespace,
        _check_charts,
        _check_services,
        _check_wire_types,
        _check_bridged,
        _check_connection_types,
        _check_overrides,
        check_override_conflicts,
    ):
        check(config, reader)


def _check_inventory(config: Config, reader: ConfigReader) -> None:
    for node in config.nodes.values():
        if reader.is_missing(CLUSTERS_FILE, node.cluster):
            reader.add_fault(
                NODES_FILE,
                f"nodes[{reader.index_of(NODES_FILE, node.id)}].cluster",
                f"'{node.cluster}' is not in clusters.yaml"
                + suggestion(node.cluster, reader.item_names(CLUSTERS_FILE)),
            )
    for broker in config.brokers.values():
        if reader.is_missing(NODES_FILE, broker.node):
            reader.add_fault(
                BROKERS_FILE,
                f"brokers[{reader.index_of(BROKERS_FILE, broker.node)}].node",
                f"'{broker.node}' is not in nodes.yaml"
                + suggestion(broker.node, reader.item_names(NODES_FILE)),
            )


def _check_topics(config: Config, reader: ConfigReader) -> None:
    roles = {role for appdef in config.appdefs.values() for role in appdef.inputs}
    for node in config.nodes.values() if roles else ():
        for role in node.topics:
            if role not in roles:
                reader.add_fault(
                    NODES_FILE,
                    f"nodes[{reader.index_of(NODES_FILE, node.id)}].topics.{role}",
                    f"'{role}' is not an input of any application" + suggestion(role, roles),
                )


def _check_namespaces(config: Config, reader: ConfigReader) -> None:
    seen: dict[str, str] = {}
    for domain in config.domains.values():
        other = seen.setdefault(domain.namespace, domain.name)
        if other != domain.name:
            reader.add_fault(
                DOMAINS_FILE,
                f"domains[{reader.index_of(DOMAINS_FILE, domain.name)}].namespace",
                f"'{domain.namespace}' is already the namespace of '{other}'; give each its own",
            )


def _check_controllers_namespace(config: Config, reader: ConfigReader) -> None:
    argocd = config.repo_settings.argocd if config.repo_settings.gitops == "argocd" else None
    for domain in config.domains.values():
        if argocd and domain.namespace == argocd.namespace:
            reader.add_fault(
                DOMAINS_FILE,
                f"domains[{reader.index_of(DOMAINS_FILE, domain.name)}].namespace",
                f"'{domain.namespace}' is Argo CD's own namespace, where an Application may do "
                "all that Argo CD may; choose another",
            )


def _check_charts(config: Config, reader: ConfigReader) -> None:
    for name, chart in config.charts.items():
        _check_chart(f"charts.{name}", chart, config, reader)
        for channel, source in chart.channels.items():
            _check_chart(f"charts.{name}.channels.{channel}", source, config, reader)


def _check_chart(where: str, chart: ChartSource, config: Config, reader: ConfigReader) -> None:
    if not chart.folder:
        return
    path = f"{chart.folder}/Chart.yaml"
    text = config.files.get(path)
    if text is None:
        message = f"'{path}' does not exist; correct the folder"
        reader.add_fault(CHARTS_FILE, f"{where}.folder", message)
        return
    try:
        metadata = strict_yaml.load(text)
    except InvalidInput as error:
        reader.faults += strict_yaml.faults_in(error, path)
        return
    version = metadata.get("version") if isinstance(metadata, dict) else None
    if version != chart.version:
        reader.add_fault(
            CHARTS_FILE,
            f"{where}.version",
            f"is {chart.version}, but {path} says {version}; make them equal",
        )


def _check_services(config: Config, reader: ConfigReader) -> None:
    prefixes: dict[str, tuple[str, str, Service]] = {}
    words = {known.word for known in connection_types.CONNECTION_TYPES}
    for appdef in config.appdefs.values():
        file = f"appdefs/{appdef.name}/appdef.yaml"
        for name, service in appdef.services.items():
            where = f"services.{name}"
            if reader.is_missing(CHARTS_FILE, service.chart):
                known = suggestion(service.chart, reader.item_names(CHARTS_FILE))
                reader.add_fault(
                    file, f"{where}.chart", f"'{service.chart}' is not in {CHARTS_FILE}{known}"
                )
            for image in service.images:
                if reader.is_missing(IMAGES_FILE, image):
                    known = suggestion(image, reader.item_names(IMAGES_FILE))
                    reader.add_fault(
                        file, f"{where}.images", f"'{image}' is not in {IMAGES_FILE}{known}"
                    )
            if config.values_template(appdef.name, service) not in config.files:
                message = f"'{service.values}' does not exist; add it beside appdef.yaml"
                reader.add_fault(file, f"{where}.values", message)
            if service.prefix in words:
                message = f"'{service.prefix}' is the prefix of connections; choose another"
                reader.add_fault(file, f"{where}.prefix", message)
                continue
            other = prefixes.setdefault(service.prefix, (appdef.name, name, service))
            if other[2] is not service and not _same(config, other, (appdef.name, name, service)):
                reader.add_fault(
                    file,
                    f"{where}.prefix",
                    f"'{service.prefix}' is used by '{other[1]}' already; choose another (only "
                    "identical services with 'each' may share a prefix)",
                )


def _same(config: Config, one: tuple[str, str, Service], other: tuple[str, str, Service]) -> bool:
    """Return whether two appdefs define the same shared service."""
    texts = [
        config.files.get(config.values_template(appdef, service))
        for appdef, _, service in (one, other)
    ]
    return bool(one[2].each) and one[1:] == other[1:] and texts[0] == texts[1]


def _check_bridged(config: Config, reader: ConfigReader) -> None:
    for node in config.nodes.values():
        for peer in node.bridged:
            if reader.is_missing(NODES_FILE, peer):
                place = f"nodes[{reader.index_of(NODES_FILE, node.id)}].bridged.{peer}"
                known = suggestion(peer, reader.item_names(NODES_FILE))
                reader.add_fault(NODES_FILE, place, f"'{peer}' is not in nodes.yaml{known}")


def _check_connection_types(config: Config, reader: ConfigReader) -> None:
    for known in connection_types.by_number():
        reader.faults += known.config_faults(config, reader)


def _check_wire_types(config: Config, reader: ConfigReader) -> None:
    seen: dict[int, str] = {}
    for appdef in config.appdefs.values():
        if appdef.deployment_request is None:
            continue
        number = appdef.deployment_request.type
        other = seen.setdefault(number, appdef.name)
        if other != appdef.name:
            reader.add_fault(
                f"appdefs/{appdef.name}/appdef.yaml",
                "deploymentRequest.type",
                f"{number} already names '{other}'; choose another number",
            )


def _check_overrides(config: Config, reader: ConfigReader) -> None:
    for override in config.overrides.values():
        for image in override.images or ():
            if reader.is_missing(IMAGES_FILE, image):
                known = suggestion(image, reader.item_names(IMAGES_FILE))
                message = f"'{image}' is not in {IMAGES_FILE}{known}"
                reader.add_fault(override.path, f"images.{image}", message)
        node = override.node
        if node is not None and reader.is_missing(NODES_FILE, node):
            known = suggestion(node, reader.item_names(NODES_FILE))
            reader.add_fault(override.path, "node", f"'{node}' is not in nodes.yaml{known}")
        elif node is not None and not reader.is_missing(NODES_FILE, node):
            _check_moved_to(node, override, config, reader)
        versions = _versions_for(override, config)
        if override.version and versions and override.version not in versions:
            reader.add_fault(
                override.path,
                "version",
                f"'{override.version}' is not a version or channel in {CHARTS_FILE} of a "
                f"selected chart{suggestion(override.version, versions)}",
            )


def _check_moved_to(node: str, override: Override, config: Config, reader: ConfigReader) -> None:
    if node in config.nodes and node not in config.domain_of and config.domains:
        message = f"'{node}' is not in any access domain; add it to one in {DOMAINS_FILE}"
        reader.add_fault(override.path, "node", message)


def _versions_for(override: Override, config: Config) -> set[str]:
    """Return the versions and channels of every chart that an override selects."""
    charts = {
        service.chart
        for appdef in config.appdefs.values()
        for name, service in appdef.services.items()
        for selector in override.select
        if (not selector.services or matches(name, selector.services))
        and (not selector.appdefs or matches(appdef.name, selector.appdefs))
    }
    return {
        known for chart in charts & {*config.charts} for known in config.charts[chart].versions()
    }
