"""Faults that only several files show together."""

from __future__ import annotations

from collections.abc import Iterator

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput, field_path, suggestion
from demandops.connections import connection_types
from demandops.model.config import config as configs
from demandops.model.config.appdef import Deployed, ServiceDefinition
from demandops.model.config.base_model import matches
from demandops.model.config.config import Config, ConfigReader
from demandops.model.config.inventory import Node, comparable_kind, kind_of
from demandops.model.config.override import patched_settings
from demandops.model.config.registry import ChartSource
from demandops.templating import charts

# ---- the checks across files and entries, for example for a prefix used twice ----
#
# They run after all files are parsed. Every check runs, and a :class:`ConfigReader` collects all
# faults.


def cross_check(config: Config, reader: ConfigReader) -> None:
    _check_inventory(config, reader)
    _check_domains(config, reader)
    _check_charts(config, reader)
    _check_services(config, reader)
    _check_versions(config, reader)
    for connection_type in connection_types.by_number():
        reader.faults += connection_type.config_faults(config, reader)
    _check_overrides(config, reader)


def _check_inventory(config: Config, reader: ConfigReader) -> None:
    roles = {role for appdef in config.appdefs.values() for role in appdef.inputs}
    folders: dict[str, str] = {}
    for node, file, place in _nodes(config, reader):
        other = folders.setdefault(folder := naming.object_name("", node.id), node.id)
        if other != node.id:
            message = f"'{other}' has the folder {folder} too; choose another id"
            reader.add_fault(file, f"{place}.id", message)
        named = [("cluster", node.cluster, configs.CLUSTERS_FILE)]
        named += [(f"bridged.{peer}", peer, configs.NODES_FILE) for peer in node.bridged]
        further = enumerate(node.access_domains)
        named += [(f"accessDomains[{n}].name", at.name, configs.DOMAINS_FILE) for n, at in further]
        for field, name, collection in named:
            reader.check_reference(file, f"{place}.{field}", name, collection, node.id)
        for name, value in node.properties.items():
            kind, first = config.property_kinds.get(name, (kind_of(value), ""))
            if kind_of(value) != kind and node.id not in config.hosts:  # once for each host
                where = f"at '{first}' in {config.file_of(configs.NODES_FILE, first)}"
                message = f"is {kind_of(value)}, but the property is {kind} {where}"
                message += "; give it the same type on all nodes"
                reader.add_fault(file, f"{place}.properties.{name}", message)
        for role in node.topics:
            if roles and role not in roles:
                message = f"'{role}' is not an input of any application{suggestion(role, roles)}"
                reader.add_fault(file, f"{place}.topics.{role}", message)
    examples = (pattern.example for pattern in config.broker_patterns.values())
    for broker in (*config.brokers.values(), *examples):
        file, place = reader.places[configs.BROKERS_FILE][broker.node]
        reader.check_reference(file, f"{place}.node", broker.node, configs.NODES_FILE, broker.node)


def _nodes(config: Config, reader: ConfigReader) -> Iterator[tuple[Node, str, str]]:
    """Yield each kind of node with its file and place, also what nodes of clusters have besides."""
    for node in config.kinds.values():
        yield node, *reader.places[configs.NODES_FILE][node.id]
    for pattern in reader.of_clusters:
        entry = pattern.example.model_copy(update={"bridged": {}})  # its peers may come with it
        yield entry, pattern.file, field_path(pattern.place)


def _check_domains(config: Config, reader: ConfigReader) -> None:
    argocd = config.repo_settings.argocd if config.repo_settings.gitops == "argocd" else None
    seen: dict[str, str] = {}
    closed = ""  # a domain that forbids the host's network
    for domain in config.domains.values():
        file, place = reader.places[configs.DOMAINS_FILE][domain.name]
        if domain.broker is not None:
            reader.check_reference(file, f"{place}.broker", domain.broker, configs.BROKERS_FILE)
        for broker in domain.broker_credentials:
            field = f"{place}.brokerCredentials.{broker}"
            reader.check_reference(file, field, broker, configs.BROKERS_FILE)
        other = seen.setdefault(domain.namespace, domain.name)
        if other != domain.name:
            message = (
                f"'{domain.namespace}' is already the namespace of '{other}'; give each "
                "access domain its own namespace"
            )
            reader.add_fault(file, f"{place}.namespace", message)
        if argocd and domain.namespace == argocd.namespace:
            message = (
                f"'{domain.namespace}' is Argo CD's own namespace, where an Application may do "
                "all that Argo CD may; choose another namespace"
            )
            reader.add_fault(file, f"{place}.namespace", message)
        if domain.pod_security == "baseline":
            closed = closed or domain.name
    # which domain a node of a cluster is in, only its id says
    anywhere = [*config.domains.values()]
    anywhere *= all(domain.pod_security == "baseline" for domain in anywhere)
    for node, file, place in _nodes(config, reader):
        own = config.domains_at(node) if config.kinds.get(node.id) is node else anywhere
        strict = (d for d in own if d.pod_security == "baseline")
        if node.host_network and (owner := next(strict, None)):
            message = (
                f"is true (the default), and podSecurity of access domain '{owner.name}' is "
                "baseline, which forbids it; set 'hostNetwork: false' or "
                "'podSecurity: host-network'"
            )
            reader.add_fault(file, f"{place}.hostNetwork", message)
    for word, file in config.entry_files[configs.CLIENTS_FILE].items():
        if closed and getattr(config.clients, word).host_network:
            message = (
                f"is true, and podSecurity of access domain '{closed}' is baseline, which "
                "forbids it; leave it out, so that each client has the setting of its node"
            )
            reader.add_fault(file, f"{word}.hostNetwork", message)


def _check_charts(config: Config, reader: ConfigReader) -> None:
    for name, chart in config.charts.items():
        file, place = reader.places[configs.CHARTS_FILE][name]
        sources: dict[str, ChartSource] = {place: chart}
        sources |= {f"{place}.channels.{name}": source for name, source in chart.channels.items()}
        for where, source in sources.items():
            path = f"{source.folder}/Chart.yaml"
            text = config.files.get(path)
            if not source.folder:
                continue
            if text is None:
                message = f"'{path}' does not exist; correct the folder"
                if not path.startswith("appdefs/"):
                    message = f"'{source.folder}' is not in appdefs/; move the chart there"
                reader.add_fault(file, f"{where}.folder", message)
                continue
            try:
                metadata = strict_yaml.load(text, path)
            except InvalidInput as error:
                reader.faults += error.faults
                continue
            version = metadata.get("version") if isinstance(metadata, dict) else None
            if version != source.version:
                message = f"is {source.version}, but {path} says {version}; make them equal"
                if version is None:
                    message = f"is {source.version}, but {path} has no version; add it there"
                reader.add_fault(file, f"{where}.version", message)
    tops = (source.folder for chart in config.charts.values() for source in chart.sources())
    folders = (folder for top in tops if top for folder in charts.folders(top, config.files))
    for folder in dict.fromkeys(folders):  # each library once, in the order in which it is needed
        reader.faults += charts.faults(folder, config.files)


def _check_services(  # noqa: PLR0912 - a branch for each fault
    config: Config, reader: ConfigReader
) -> None:
    prefixes: dict[str, tuple[str, str]] = {}
    files: dict[str, str] = {}
    words = {connection_type.word for connection_type in connection_types.CONNECTION_TYPES}
    # (file, beginning of the paths of its fields, name, definition)
    defined: list[tuple[str, str, str, Deployed]] = [
        (f"appdefs/{appdef.name}/appdef.yaml", f"services.{name}.", name, own)
        for appdef in config.appdefs.values()
        for name, own in appdef.services.items()
    ]
    for name, shared in config.definitions.items():
        defined.append((f"appdefs/{name}/service.yaml", "", name, shared))
    for file, where, name, service in defined:
        folder, _, own = file.rpartition("/")
        reader.check_reference(file, f"{where}chart", service.chart, configs.CHARTS_FILE)
        for image in service.images:
            reader.check_reference(file, f"{where}images", image, configs.IMAGES_FILE)
        if f"{folder}/{service.values}" not in config.files:
            message = f"'{service.values}' does not exist; add it beside {own}"
            reader.add_fault(file, f"{where}values", message)
        for word, value in (service.place.properties if service.place else {}).items():
            kind, first = config.property_kinds.get(word, (None, ""))
            if kind and comparable_kind(value) != kind:
                registry = config.file_of(configs.NODES_FILE, first)
                message = (
                    f"asks for {comparable_kind(value)}, but the property is {kind} at '{first}' "
                    f"in {registry}; ask for {kind}"
                )
                reader.add_fault(file, f"{where}place.properties.{word}", message)
        if service.prefix in words:
            message = f"'{service.prefix}' is the prefix of connections; choose another prefix"
            reader.add_fault(file, f"{where}prefix", message)
            continue
        if service.each or isinstance(service, ServiceDefinition):
            other = files.setdefault(name, file)
            if other != file:
                message = (
                    f"'{name}' is defined in {other} too; choose another name, or define it once "
                    f"in appdefs/{name}/service.yaml and use it in both"
                )
                reader.add_fault(file, where.rstrip("."), message)
                continue
        # releases of two services with one prefix could have the same name
        owner = prefixes.setdefault(service.prefix, (file, name))
        if owner != (file, name):
            message = (
                f"'{service.prefix}' is already the prefix of '{owner[1]}'; choose another prefix"
            )
            reader.add_fault(file, f"{where}prefix", message)
    origins: dict[str, tuple[str, str]] = {}
    for name, definition in config.definitions.items():
        file = f"appdefs/{name}/service.yaml"
        for cluster, node in definition.nodes.items():
            reader.check_reference(file, f"nodes.{cluster}", cluster, configs.CLUSTERS_FILE)
            reader.check_reference(file, f"nodes.{cluster}", node, configs.NODES_FILE)
            actual = config.nodes[node].cluster if node in config.nodes else cluster
            if actual != cluster:
                message = f"'{node}' is in cluster '{actual}'; name a node of '{cluster}'"
                reader.add_fault(file, f"nodes.{cluster}", message)
    for appdef, services in config.services.items():
        for name, service in services.items():
            if not service.shared or service.each is None:
                continue
            # one instance for each topic serves all appdefs, so they must mean the same topics
            origin = service.inputs[service.each]
            first, other = origins.setdefault(name, (appdef, origin))
            if origin != other:
                reader.add_fault(
                    f"appdefs/{appdef}/appdef.yaml",
                    f"uses.{name}.{service.each}",
                    f"is '{origin}', but '{other}' in appdefs/{first}/appdef.yaml; both "
                    "definitions share the service, so give this input the same origin in both",
                )


def _check_versions(  # noqa: PLR0912 - a branch for each fault
    config: Config, reader: ConfigReader
) -> None:
    for name, appdef in config.appdefs.items():
        # an invalid entry may be the missing one
        is_unlisted = not reader.files_of[configs.VERSIONS_FILE] or reader.is_missing(
            configs.VERSIONS_FILE, name
        )
        if appdef.versions != "refuse" and is_unlisted:
            message = (
                f"is {appdef.versions}, but {config.place_of(configs.VERSIONS_FILE)} does not list "
                f"the versions of '{name}'; add them there, or remove 'versions'"
            )
            reader.add_fault(f"appdefs/{name}/appdef.yaml", "versions", message)
        own = config.services.get(name, {}) if appdef.versions == "separate" else {}
        for service in own.values():
            origin = service.inputs[service.each] if service.shared and service.each else ""
            producer = own.get(origin.partition(".")[0])
            if producer is not None and not producer.shared:
                reader.add_fault(
                    f"appdefs/{name}/appdef.yaml",
                    f"uses.{service.name}.{service.each}",
                    f"the shared service '{service.name}' reads '{origin}' and runs once for all "
                    f"versions, but '{producer.name}' runs once for each version (versions: "
                    f"separate); make '{producer.name}' a shared service too, or define "
                    f"'{service.name}' in this appdef",
                )
    for name, listed in config.versions.items():
        file, place = reader.places[configs.VERSIONS_FILE][name]
        if name not in config.appdefs:
            # an appdef.yaml that exists but is invalid has faults of its own
            if f"appdefs/{name}/appdef.yaml" not in reader.files:
                hint = suggestion(name, config.appdefs)
                reader.add_fault(file, place, f"'{name}' is not an application definition{hint}")
            continue
        services = config.services.get(name, {}).values()
        if not services:  # the definition has faults of its own
            continue
        charts = {service.chart for service in services}
        images = {image for service in services for image in service.images}
        for version, contents in listed.versions.items():
            where = f"{place}.versions.{version}"
            for chart, wanted in contents.charts.items():
                _check_used(file, f"{where}.charts.{chart}", chart, charts, name, reader)
                listed_chart = config.charts.get(chart) if chart in charts else None
                if listed_chart is not None and listed_chart.at(wanted) is None:
                    hint = suggestion(wanted, [each.version for each in listed_chart.sources()])
                    registry = config.file_of(configs.CHARTS_FILE, chart)
                    message = f"'{wanted}' is not a version of {chart} in {registry}{hint}"
                    reader.add_fault(file, f"{where}.charts.{chart}", message)
            for image in contents.images:
                _check_used(file, f"{where}.images.{image}", image, images, name, reader)
    numbers: dict[int, str] = {}
    for appdef in config.appdefs.values():
        if appdef.deployment_request is None:
            continue
        number = appdef.deployment_request.type
        other = numbers.setdefault(number, appdef.name)
        if other != appdef.name:
            message = f"{number} already names '{other}'; choose another number"
            reader.add_fault(
                f"appdefs/{appdef.name}/appdef.yaml", "deploymentRequest.type", message
            )


def _check_used(
    file: str, where: str, name: str, used: set[str], appdef: str, reader: ConfigReader
) -> None:
    if name not in used:
        message = f"no service of {appdef} uses '{name}'{suggestion(name, used)}"
        reader.add_fault(file, where, message)


def _check_overrides(config: Config, reader: ConfigReader) -> None:
    for override in config.overrides.values():
        for image in override.images or ():
            reader.check_reference(override.path, f"images.{image}", image, configs.IMAGES_FILE)
        if override.node is not None:
            reader.check_reference(override.path, "node", override.node, configs.NODES_FILE)
        selected = [
            service
            for appdef, services in config.services.items()
            for name, service in services.items()
            for selector in override.select
            if selector.takes(name, appdef)
        ]
        if override.node is not None:
            if selected and not any(service.is_movable for service in selected):
                message = (
                    f"moves nothing, because {selected[0].name} runs at its sources or at the "
                    "nodes that its definition lists; change its definition, or remove 'node'"
                )
                reader.add_fault(override.path, "node", message)
            if (
                override.node in config.nodes
                and override.node not in config.domain_of
                and config.domains
                and configs.DOMAINS_FILE not in reader.incomplete
                # a node that several domains match is in none, and has a fault of its own
                and not any(matches(override.node, d.nodes) for d in config.domains.values())
            ):
                message = f"'{override.node}' is not in any access domain; add it to one in "
                message += config.place_of(configs.DOMAINS_FILE)
                reader.add_fault(override.path, "node", message)
        if override.values and override.patches_clients():
            try:
                # MQTT clients have every field that other clients have
                patched_settings(config.clients.mqtt, override.values, override.path)
            except InvalidInput as error:
                reader.faults += error.faults
        charts = {service.chart for service in selected} & {*config.charts}
        versions = {version for chart in charts for version in config.charts[chart].versions()}
        if override.version and versions and override.version not in versions:
            message = (
                f"'{override.version}' is not a version or channel that "
                f"{config.place_of(configs.CHARTS_FILE)} has for a selected chart"
                f"{suggestion(override.version, versions)}"
            )
            reader.add_fault(override.path, "version", message)
