"""Loading of the configuration: the files' texts become a :class:`Config`.

The functions here are pure. If any file has a fault, the whole configuration is rejected, with
every fault of every file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import PurePosixPath
from types import MappingProxyType
from typing import Any, TypeVar

from demandops.base.errors import field_path, suggestion
from demandops.base.quoting import quoted
from demandops.base.settings import API_VERSION, RENDER_VERSION
from demandops.model.config import config as configs
from demandops.model.config import discovered, inventory, registry
from demandops.model.config.appdef import (
    ApplicationDefinition,
    ServiceDefinition,
    Services,
    resolved_services,
)
from demandops.model.config.base_model import matches
from demandops.model.config.config import Config, ConfigReader
from demandops.model.config.cross_check import cross_check
from demandops.model.config.entry_patterns import EntryPatterns, OnDemand, UnlistedNodes
from demandops.model.config.inventory import Node, id_in_domain
from demandops.model.config.override import OVERRIDES_ROOT, Override, OverrideFile
from demandops.model.config.policy import AccessDomain, AccessDomainsFile
from demandops.model.config.repo_settings import ROOT_FILE, Flux, RepoSettings

Definition = TypeVar("Definition", ApplicationDefinition, ServiceDefinition)

_NAME = re.compile(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?")
_ANY = RepoSettings(
    apiVersion=API_VERSION,
    kind="StateRepository",
    gitops="flux",
    renderVersion=RENDER_VERSION,
    flux=Flux(url="https://unread.invalid/repo.git"),
)  # replaces settings that are not valid, so that the other files can be checked


def load(files: Mapping[str, str]) -> Config:  # noqa: PLR0912, PLR0915 - each kind of file
    """Return the configuration of a state repo; other files are ignored."""
    reader = ConfigReader(files)
    repository = reader.read_file(ROOT_FILE, RepoSettings)
    if repository and repository.render_version > RENDER_VERSION:
        message = (
            f"is {repository.render_version}, but this generator renders version "
            f"{RENDER_VERSION}; write {RENDER_VERSION}, or update the generator if `demandops "
            "upgrade` of a newer one wrote this"
        )
        reader.add_fault(ROOT_FILE, "renderVersion", message)
    if repository and getattr(repository, repository.gitops) is None:
        message = (
            f"is missing, but 'gitops' is {repository.gitops}; add it, with the 'url' from which "
            "the clusters fetch this repo"
        )
        reader.add_fault(ROOT_FILE, repository.gitops, message)
    _refuse_unread(reader)
    clusters = reader.read_items(
        configs.CLUSTERS_FILE, inventory.ClustersFile, "clusters", inventory.Cluster, "name"
    )
    nodes = reader.read_items(configs.NODES_FILE, inventory.NodesFile, "nodes", Node, "id")
    appdefs = _read_definitions(reader, "appdef.yaml", ApplicationDefinition)
    definitions = _read_definitions(reader, "service.yaml", ServiceDefinition)
    of_appdefs = chain.from_iterable(appdef.services.values() for appdef in appdefs.values())
    deployed = (*of_appdefs, *definitions.values())
    required = [each.place.properties for each in deployed if each.place]
    by_people = (*(node.properties for node in nodes.values()), *required)
    numbers = frozenset(
        name
        for properties in by_people
        for name, value in properties.items()
        if inventory.comparable_kind(value) == "a number"
    )
    patterns = reader.patterns[configs.NODES_FILE]
    patterns[:] = [  # few have any, and each makes its example anew
        replace(each, numbers=numbers) if numbers & {*each.data.get("properties", ())} else each
        for each in patterns
    ]
    nodes |= discovered.read_nodes(reader, clusters, nodes, required)
    domains = reader.read_items(
        configs.DOMAINS_FILE, AccessDomainsFile, "domains", AccessDomain, "name"
    )
    settings = repository or _ANY
    patterns = reader.patterns[configs.NODES_FILE] + reader.of_clusters
    for each in patterns:
        if written := each.example.capacity:
            place = f"{field_path(each.place)}.capacity"
            _with_short_names(written, settings, reader, each.file, place)
    for id, node in nodes.items():
        if node.capacity is None:
            continue
        file, place = reader.places[configs.NODES_FILE][id]
        if discovered.is_discovered(file):  # of entry and cluster, the cluster is the later one
            named = settings.with_short_names(node.capacity)
        else:
            named = _with_short_names(node.capacity, settings, reader, file, f"{place}.capacity")
        nodes[id] = node.model_copy(update={"capacity": named})

    def completed(node: Node, domain: AccessDomain | None) -> Node:
        node = _in_ros_domain(node, domain)
        capacity = settings.with_short_names(node.capacity) if node.capacity else node.capacity
        return node.model_copy(update={"capacity": capacity})

    def problems(node: Node) -> Iterator[tuple[str, str]]:
        # what nobody sees before the id is known
        further = [(f"accessDomains[{i}].name", at) for i, at in enumerate(node.access_domains)]
        asked: list[tuple[str, str, str, Mapping[str, Any]]]
        asked = [("cluster", "cluster", node.cluster, clusters)]
        asked += [(field, "access domain", at.name, domains) for field, at in further]
        for field, what, name, known in asked:
            if name not in known:
                yield field, f"there is no {what} {quoted(name)}{suggestion(name, known)}"
        if first := unlisted.first_domain(node.id):
            yield from _clashes(reader, node, first, domains)

    node_patterns = EntryPatterns("node", reader.patterns[configs.NODES_FILE], problems)
    unlisted = UnlistedNodes(node_patterns, domains, completed)
    reader.why_not[configs.NODES_FILE] = unlisted.why_not
    clients = registry.ClientsFile(apiVersion=API_VERSION, kind="Clients")
    client_files = dict[str, str]()
    for file in reader.files_of[configs.CLIENTS_FILE]:
        part = reader.read_file(file, registry.ClientsFile)
        words = part.model_fields_set - {"apiVersion", "kind"} if part else set()
        for word in sorted(words):
            first = client_files.setdefault(word, file)
            if first != file:
                reader.add_duplicate(word, (first, word), (file, word))
            clients = clients.model_copy(update={word: getattr(part, word)})
    domain_of = _domains_of_nodes(reader, nodes, domains, unlisted)
    all_nodes, domain_of, hosts = _in_further_domains(reader, nodes, domains, domain_of)
    for pattern in node_patterns.values():
        node, at = pattern.example, reader.places[configs.NODES_FILE][pattern.id]
        for further in node.access_domains:
            reader.places[configs.NODES_FILE][id_in_domain(node.id, further.name)] = at
        places = unlisted.places(node, clusters) if node.access_domains else ()
        clashes = ([*_clashes(reader, *place, domains)] for place in places)
        if (found := next(clashes, [])) and all(clashes):  # else some id has none
            for field, message in found:
                reader.add_fault(at[0], f"{at[1]}.{field}", message)
    all_nodes = {id: _in_ros_domain(node, domain_of.get(id)) for id, node in all_nodes.items()}
    if node_patterns:
        all_nodes = OnDemand(all_nodes, lambda id: (made := unlisted.find(id)) and made.node)
        domain_of = OnDemand(domain_of, lambda id: (made := unlisted.find(id)) and made.domain)
        hosts = OnDemand(hosts, lambda id: (made := unlisted.find(id)) and made.host)
    services = {
        name: _services_of(appdef, definitions, all_nodes, settings, reader)
        for name, appdef in appdefs.items()
    }
    brokers = reader.read_items(
        configs.BROKERS_FILE, inventory.BrokersFile, "brokers", inventory.Broker, "node"
    )

    def problems_of_broker(broker: inventory.Broker) -> Iterator[tuple[str, str]]:
        if (name := broker.node) not in all_nodes:
            yield "node", f"there is no node {quoted(name)}{suggestion(name, all_nodes)}"

    broker_patterns = EntryPatterns(
        "broker", reader.patterns[configs.BROKERS_FILE], problems_of_broker
    )
    reader.why_not[configs.BROKERS_FILE] = lambda node: broker_patterns.find(node)[1]
    if broker_patterns:
        brokers = OnDemand(brokers, lambda node: broker_patterns.find(node)[0])
    charts = reader.read_items(configs.CHARTS_FILE, registry.ChartsFile, "charts", registry.Chart)
    images = reader.read_items(configs.IMAGES_FILE, registry.ImagesFile, "images", registry.Image)
    for name, image in images.items():
        head = reader.heads.get(reader.places[configs.IMAGES_FILE][name][0])
        if isinstance(head, registry.ImagesFile) and head.registry is not None:
            images[name] = image.pulled_from(head.registry)
    versions: Mapping[str, registry.VersionList] = {}
    if reader.files_of[configs.VERSIONS_FILE]:  # this collection alone may have no file
        versions = reader.read_items(
            configs.VERSIONS_FILE, registry.VersionsFile, "applications", registry.VersionList
        )
    overrides: dict[str, Override] = {}
    for path in sorted(reader.files):
        folder, _, file = path.partition("/")
        if folder != OVERRIDES_ROOT or file.startswith(".") or file.endswith(".md"):
            continue
        name = file.removesuffix(".yaml")
        if name == file or not is_override_name(name):
            message = (
                "is not an override file; rename it to overrides/<name>.yaml, where <name> has up "
                "to 63 lower-case letters, digits and '-' between them, or remove it"
            )
            reader.add_fault(path, "", message)
        elif (override := reader.read_file(path, OverrideFile)) is not None:
            overrides[name] = Override.from_file(name, override)
    entry_files: dict[str, dict[str, str]] = {
        collection: {name: file for name, (file, _) in places.items()}
        for collection, places in reader.places.items()
    }
    config = Config(
        repo_settings=settings,
        clusters=clusters,
        nodes=all_nodes,
        node_patterns=node_patterns,
        broker_patterns=broker_patterns,
        unlisted=unlisted,
        brokers=brokers,
        domains=domains,
        charts=charts,
        images=images,
        clients=clients,
        versions=versions,
        appdefs=appdefs,
        definitions=definitions,
        services=MappingProxyType(services),
        domain_of=domain_of,
        hosts=hosts,
        files=MappingProxyType({p: text for p, text in files.items() if p.startswith("appdefs/")}),
        gone_since=reader.gone_since,
        overrides=MappingProxyType(overrides),
        entry_files={**entry_files, configs.CLIENTS_FILE: client_files},
    )
    cross_check(config, reader)
    if reader.faults:
        raise discovered.InvalidConfig(reader)
    return config


def _refuse_unread(reader: ConfigReader) -> None:
    # whoever mistypes a file's name must not believe that its entries are in force
    folders = {collection.partition("/")[0] for collection in configs.COLLECTIONS}
    for path in sorted(reader.files):
        folder, *names = path.split("/")
        if folder not in folders or not path.endswith((".yaml", ".yml")):
            continue
        if discovered.is_discovered(path):  # people see with `check` that they may not edit it
            continue
        if configs.collection_of(path) is None and not any(name.startswith(".") for name in names):
            stems = [
                PurePosixPath(file).stem for file in configs.COLLECTIONS if file.startswith(folder)
            ]
            message = (
                f"is not read; only <name>.yaml and <name>/*.yaml in {folder}/ are read, where "
                f"<name> is one of {', '.join(sorted(stems))}; rename the file, or remove it"
            )
            reader.add_fault(path, "", message)


def _read_definitions(
    reader: ConfigReader, file: str, model: type[Definition]
) -> Mapping[str, Definition]:
    definitions = {}
    for path in sorted(reader.files):
        parts = path.split("/")
        if len(parts) != 3 or parts[0] != "appdefs" or parts[2] != file:
            continue
        folder, definition = parts[1], reader.read_file(path, model)
        if definition is None:
            continue
        if definition.name != folder:
            message = f"is '{definition.name}', but the folder is '{folder}'; make them equal"
            reader.add_fault(path, "name", message)
            # go on with the folder's name, so that others who use it get no fault
            definition = definition.model_copy(update={"name": folder})
        definitions[folder] = definition
    return MappingProxyType(definitions)


def _services_of(
    appdef: ApplicationDefinition,
    definitions: Mapping[str, ServiceDefinition],
    nodes: Mapping[str, Node],
    settings: RepoSettings,
    reader: ConfigReader,
) -> Services:
    files = {f"appdefs/{name}/service.yaml" for name in appdef.uses.keys() - definitions.keys()}
    if files & reader.files.keys():  # an invalid definition, which has faults of its own
        return {}
    resolved, problems = resolved_services(appdef, definitions)
    for where, problem in problems:
        reader.add_fault(f"appdefs/{appdef.name}/appdef.yaml", where, problem)
    services = dict(resolved)
    for name, service in resolved.items():
        if service.requests:
            place = "requests" if service.shared else f"services.{name}.requests"
            named = _with_short_names(service.requests, settings, reader, service.file, place)
            of_pods = {"requests": named, "pod_requests": settings.requests_of_pods(named)}
            services[name] = service.model_copy(update=of_pods)
        if service.nodes:
            runs_at = _by_cluster(service.nodes, nodes)
            services[name] = services[name].model_copy(update={"runs_at": runs_at})
    return services


def _by_cluster(at: Mapping[str, str], nodes: Mapping[str, Node]) -> Mapping[str, str]:
    listed = {id: at[node.cluster] for id, node in nodes.items() if node.cluster in at}
    return OnDemand(listed, lambda id: at.get(nodes[id].cluster) if id in nodes else None)


def _with_short_names(
    amounts: Mapping[str, str], settings: RepoSettings, reader: ConfigReader, file: str, place: str
) -> dict[str, str]:
    # one name for each resource, so that placement need not know that it has two
    named = settings.with_short_names(amounts)
    for name in amounts.keys() - named.keys() if len(named) < len(amounts) else ():
        (short,) = settings.with_short_names({name: ""})
        reader.add_fault(file, place, f"'{name}' and '{short}' are one resource; keep one of them")
    return named


def is_override_name(name: str) -> bool:
    return _NAME.fullmatch(name) is not None


def _in_ros_domain(node: Node, domain: AccessDomain | None) -> Node:
    if domain is None or domain.ros is None:
        return node
    ros = node.ros.model_copy(update={"domain_id": domain.ros.domain_id})
    return node.model_copy(update={"ros": ros})


def _in_further_domains(
    reader: ConfigReader,
    nodes: Mapping[str, Node],
    domains: Mapping[str, AccessDomain],
    domain_of: Mapping[str, AccessDomain],
) -> tuple[Mapping[str, Node], Mapping[str, AccessDomain], Mapping[str, str]]:
    """Return nodes, domains and hosts, with ``<id>@<domain>`` for each further domain."""
    # Everything follows from the node: namespace, rules, quotas, keys of releases. A domain beside
    # each node would have to be asked for at each place, and a place that forgets it would mix the
    # data of two domains.
    nodes, domain_of, hosts = dict(nodes), dict(domain_of), dict[str, str]()
    for node in [node for node in nodes.values() if node.access_domains]:  # `nodes` grows
        file, place = reader.places[configs.NODES_FILE][node.id]
        first = domain_of.get(node.id)
        if first is None:
            # the node may be in an invalid domain, or in several, which has a fault of its own
            is_matched = any(matches(node.id, d.nodes) for d in domains.values())
            if not is_matched and configs.DOMAINS_FILE not in reader.incomplete:
                message = f"no access domain has '{node.id}' in its nodes; add it to one"
                reader.add_fault(file, f"{place}.accessDomains[0]", message)
            continue
        for field, message in _clashes(reader, node, first, domains):
            reader.add_fault(file, f"{place}.{field}", message)
        for index, further in enumerate(node.access_domains):
            id, domain = id_in_domain(node.id, further.name), domains.get(further.name)
            if id in nodes and id not in hosts:
                message = f"a node of the inventory has the id '{id}'; rename that node"
                reader.add_fault(file, f"{place}.accessDomains[{index}].name", message)
            elif domain is not None:
                # the first domain keeps the plain name, so a further one changes nothing that runs
                nodes[id], domain_of[id], hosts[id] = node.in_domain(further), domain, node.id
                reader.places[configs.NODES_FILE][id] = (file, place)
    return nodes, MappingProxyType(domain_of), MappingProxyType(hosts)


def _clashes(
    reader: ConfigReader, node: Node, first: AccessDomain, domains: Mapping[str, AccessDomain]
) -> Iterator[tuple[str, str]]:
    """Yield each further domain of a node that is no other than those before it, by its field."""
    names, numbers = {first.name}, {_in_ros_domain(node, first).ros.domain_id: first.name}
    for index, further in enumerate(node.access_domains):
        field, domain = f"accessDomains[{index}].name", domains.get(further.name)
        if domain is None:
            continue
        number = _in_ros_domain(node, domain).ros.domain_id
        other = numbers.setdefault(number, domain.name)
        if domain.name in names:
            yield field, f"'{node.id}' is already in '{domain.name}'; remove this entry"
        elif other != domain.name:
            message = (
                f"access domains '{other}' and '{domain.name}' share ROS domain {number}, so each "
                f"would read the other's topics on '{node.id}'; give one of them "
                "'ros: {domainId: …}' in " + reader.places[configs.DOMAINS_FILE][domain.name][0]
            )
            yield field, message
        names.add(domain.name)


# How many of the domains that match one node a message names
_MOST_DOMAINS = 3


def _domains_of_nodes(
    reader: ConfigReader,
    nodes: Mapping[str, Node],
    domains: Mapping[str, AccessDomain],
    unlisted: UnlistedNodes,
) -> Mapping[str, AccessDomain]:
    owner: dict[str, AccessDomain] = {}
    for node in nodes:
        matching: dict[str, str] = {}
        for pattern, name in unlisted.globs.matching(node):
            matching.setdefault(name, pattern)
            if len(matching) > _MOST_DOMAINS:
                break
        file, place = reader.places[configs.NODES_FILE][node]
        if len(matching) > 1 and discovered.is_discovered(file):
            continue  # a label in a cluster must not make people's files invalid
        if len(matching) > 1:  # an overlap by accident must not move the node
            by = " and ".join(
                f"'{name}' by {quoted(pattern)} in {reader.places[configs.DOMAINS_FILE][name][0]}"
                for name, pattern in sorted(matching.items())[:_MOST_DOMAINS]
            )
            message = (
                f"'{node}' is in the access domains {by}; narrow these patterns so that only one "
                "domain matches the node, and list the other domains under 'accessDomains' of the "
                "node"
            )
            reader.add_fault(file, f"{place}.id", message)
        elif matching:
            owner[node] = domains[next(iter(matching))]
    return MappingProxyType(owner)
