"""Checks across files and entries: an unknown cluster, a prefix that is used twice.

They run when all files are parsed. Every check runs, and the reader collects all faults.

Two overrides of equal priority must not change one release differently. That check rejects doubtful
pairs, so that no later demand meets a conflict. A field separates two selectors only if a release
has a single value for it, like service and node. A shared service has many applications and
requesters, a Zenoh bridge many connections.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations

from demandops import strict_yaml
from demandops.config.appdef import ApplicationDefinition, Service
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
from demandops.config.override import Override, Selector, by_rank
from demandops.config.policy import matches
from demandops.config.registry import ChartSource
from demandops.connections import connection_types
from demandops.errors import InvalidInput, suggestion


def cross_check(config: Config, reader: ConfigReader) -> None:
    """Add every fault across files or entries to the reader."""
    for check in (
        _check_inventory,
        _check_namespaces,
        _check_charts,
        _check_services,
        _check_wire_types,
        _check_connection_types,
        _check_overrides,
        _check_override_conflicts,
    ):
        check(config, reader)


def _check_inventory(config: Config, reader: ConfigReader) -> None:
    roles = {role for appdef in config.appdefs.values() for role in appdef.inputs}
    for node in config.nodes.values():
        place = reader.place_of(NODES_FILE, node.id)
        reader.check_reference(NODES_FILE, f"{place}.cluster", node.cluster, CLUSTERS_FILE)
        for peer in node.bridged:
            reader.check_reference(NODES_FILE, f"{place}.bridged.{peer}", peer, NODES_FILE)
        for role in node.topics:
            if roles and role not in roles:
                message = f"'{role}' is not an input of any application{suggestion(role, roles)}"
                reader.add_fault(NODES_FILE, f"{place}.topics.{role}", message)
    for broker in config.brokers.values():
        place = reader.place_of(BROKERS_FILE, broker.node)
        reader.check_reference(BROKERS_FILE, f"{place}.node", broker.node, NODES_FILE)


def _check_namespaces(config: Config, reader: ConfigReader) -> None:
    argocd = config.repo_settings.argocd if config.repo_settings.gitops == "argocd" else None
    seen: dict[str, str] = {}
    for domain in config.domains.values():
        place = f"{reader.place_of(DOMAINS_FILE, domain.name)}.namespace"
        other = seen.setdefault(domain.namespace, domain.name)
        if other != domain.name:
            reader.add_fault(
                DOMAINS_FILE,
                place,
                f"'{domain.namespace}' is already the namespace of '{other}'; give each its own",
            )
        if argocd and domain.namespace == argocd.namespace:
            reader.add_fault(
                DOMAINS_FILE,
                place,
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
        metadata = strict_yaml.load(text, path)
    except InvalidInput as error:
        reader.faults += error.faults
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
            reader.check_reference(file, f"{where}.chart", service.chart, CHARTS_FILE)
            for image in service.images:
                reader.check_reference(file, f"{where}.images", image, IMAGES_FILE)
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
            reader.check_reference(override.path, f"images.{image}", image, IMAGES_FILE)
        if override.node is not None:
            reader.check_reference(override.path, "node", override.node, NODES_FILE)
            _check_moved_to(override.node, override, config, reader)
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
        if selector.takes(name, appdef.name)
    }
    return {
        known for chart in charts & {*config.charts} for known in config.charts[chart].versions()
    }


_MERGED = ("values", "images")
_SINGLE = ("version", "replicas", "node")
_FROZEN = (*_SINGLE, *_MERGED)


def _check_override_conflicts(config: Config, reader: ConfigReader) -> None:
    """Add a fault for each pair of overrides that needs an order but has the same priority."""
    for one, other in combinations(by_rank(config.overrides.values()), 2):
        if one.priority != other.priority:
            continue
        contested = contested_effects(one, other)
        if contested and can_meet(one.select, other.select, config):
            reader.add_fault(
                other.path,
                "priority",
                f"is {other.priority}, as in {one.path}, and both may set "
                f"{' and '.join(contested)} of the same release; give one of them another "
                "priority, or select different releases",
            )


def contested_effects(one: Override, other: Override) -> list[str]:
    """Return the effects for which the order of two overrides matters."""
    contested = [
        name
        for name in _SINGLE
        if None not in (left := getattr(one, name), right := getattr(other, name)) and left != right
    ]
    if one.values and other.values and not patches_commute(one.values, other.values):
        contested.append("values")
    pins = (one.images or {}, other.images or {})
    contested += [
        f"images.{name}"
        for name in sorted({*pins[0]} & {*pins[1]})
        if pins[0][name] != pins[1][name]
    ]
    for holding, shaping in ((one, other), (other, one)):
        effects = [name for name in shaping.effects() if name in _FROZEN]
        if holding.hold and effects:
            contested += ["hold", *effects]
    return contested


def patches_commute(one: object, other: object) -> bool:
    """Return whether two merge patches have the same result in either order."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return all(patches_commute(one[key], other[key]) for key in one if key in other)
    return json.dumps(one, sort_keys=True) == json.dumps(
        other, sort_keys=True
    )  # unlike ==, it distinguishes 1 from True


def can_meet(one: Iterable[Selector], other: Iterable[Selector], config: Config) -> bool:
    """Return whether one release, now or later, may match selectors of both overrides."""
    others = list(other)
    return any(_meet(left, right, config) for left in one for right in others)


def _meet(one: Selector, other: Selector, config: Config) -> bool:
    if (one.connections and _selects_services(other)) or (
        other.connections and _selects_services(one)
    ):
        return False
    for name in _separating_fields(one, other, config):
        left, right = getattr(one, name), getattr(other, name)
        if left and right and not any(patterns_overlap(a, b) for a in left for b in right):
            return False
    left, right = one.labels or {}, other.labels or {}
    return all(left[key] == right[key] for key in left if key in right)


def _selects_services(selector: Selector) -> bool:
    return bool(selector.applications or selector.appdefs or selector.services)


def _separating_fields(one: Selector, other: Selector, config: Config) -> Iterator[str]:
    """Yield the fields for which a release that both may match has a single value."""
    yield from ("services", "nodes")
    if not any(_shared(one, other, appdef) for appdef in config.appdefs.values()):
        yield from ("applications", "appdefs")
    if not any(known.shares_clients(config) for known in connection_types.CONNECTION_TYPES):
        yield "connections"


def _shared(one: Selector, other: Selector, appdef: ApplicationDefinition) -> bool:
    """Return whether both may match a shared service of an appdef."""
    return any(
        service.each is not None
        and all(not s.services or matches(name, s.services) for s in (one, other))
        for name, service in appdef.services.items()
    )


def patterns_overlap(one: str, other: str) -> bool:
    """Return whether any text matches both patterns (``*`` any characters, ``?`` one)."""
    # whether what was read of ``one`` overlaps with each beginning of ``other``
    row = [not other[:length].strip("*") for length in range(len(other) + 1)]
    for a in one:
        after = [row[0] and a == "*"]
        for b, above, before in zip(other, row[1:], row, strict=False):
            if "*" in (a, b):
                after.append(above or after[-1])
            else:
                after.append(before and (a == b or "?" in (a, b)))
        row = after
    return row[-1]
