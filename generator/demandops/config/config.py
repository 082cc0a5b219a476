"""The whole configuration as one frozen, indexed value: :class:`Config`."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from demandops import naming
from demandops.config.appdef import ApplicationDefinition, Service, ServiceDefinition, Services
from demandops.config.inventory import Broker, Cluster, Node, id_in_domain
from demandops.config.node_property import Kind, kind_of
from demandops.config.override import OVERRIDES_ROOT, Override
from demandops.config.policy import AccessDomain
from demandops.config.registry import (
    DEFAULT_SETTINGS,
    ApplicationVersion,
    Chart,
    ClientsFile,
    Image,
    ImagePin,
    VersionList,
)
from demandops.config.repo_settings import RepoSettings
from demandops.errors import Refused

CLUSTERS_FILE = "inventory/clusters.yaml"
NODES_FILE = "inventory/nodes.yaml"
BROKERS_FILE = "inventory/brokers.yaml"
DOMAINS_FILE = "policy/access-domains.yaml"
CHARTS_FILE = "registry/charts.yaml"
IMAGES_FILE = "registry/images.yaml"
CLIENTS_FILE = "registry/clients.yaml"
VERSIONS_FILE = "registry/versions.yaml"

# The collections of entries, each named by the file that usually lists its entries. Files in the
# folder `inventory/nodes/` may list further entries of the collection `inventory/nodes.yaml`, and
# likewise for the others (`collection_of`).
COLLECTIONS = (
    CLUSTERS_FILE,
    NODES_FILE,
    BROKERS_FILE,
    DOMAINS_FILE,
    CHARTS_FILE,
    IMAGES_FILE,
    CLIENTS_FILE,
    VERSIONS_FILE,
)

# The top-level entries of a state repo that hold the configuration, which people write
CONFIG_ROOTS = ("demandops.yaml", "inventory", "policy", "registry", "appdefs", OVERRIDES_ROOT)


def collection_of(path: str) -> str | None:
    """Return the collection to which the entries of a file belong, if any.

    ``inventory/nodes.yaml`` and ``inventory/nodes/berlin.yaml`` have entries of the collection
    ``inventory/nodes.yaml``.
    """
    folder, _, name = path.rpartition("/")
    if name.startswith(".") or not name.endswith(".yaml"):
        return None
    return next((file for file in (path, f"{folder}.yaml") if file in COLLECTIONS), None)


def place_of_collection(collection: str, files: Iterable[str]) -> str:
    """Return the text for a collection's files: ``inventory/nodes.yaml or inventory/nodes/``."""
    used = {*files} or {collection}
    folder = [collection.replace(".yaml", "/")] if used - {collection} else []
    return " or ".join([collection] * (collection in used) + folder)


@dataclass(frozen=True, slots=True)
class Config:
    """What can run, where, and from which charts and images.

    Most mappings go from the name of an entry to the entry.
    """

    repo_settings: RepoSettings
    clusters: Mapping[str, Cluster]
    nodes: Mapping[str, Node]
    brokers: Mapping[str, Broker]
    domains: Mapping[str, AccessDomain]
    charts: Mapping[str, Chart]
    images: Mapping[str, Image]
    appdefs: Mapping[str, ApplicationDefinition]
    definitions: Mapping[str, ServiceDefinition]
    # For each appdef, its own services and those of `definitions` that it uses
    services: Mapping[str, Services]
    domain_of: Mapping[str, AccessDomain]
    # The text of each file below `appdefs/`, such as a template or a chart, by path
    files: Mapping[str, str]
    # For each node in a further access domain (`edge@city`), the inventory's id (`edge`)
    hosts: Mapping[str, str] = field(default_factory=dict)
    # Every override; `demandops.ledger.world.World` knows which of them have ended
    overrides: Mapping[str, Override] = field(default_factory=dict)
    clients: ClientsFile = DEFAULT_SETTINGS
    versions: Mapping[str, VersionList] = field(default_factory=dict)
    # For each collection, a map from each entry to the file that has the entry
    entry_files: Mapping[str, Mapping[str, str]] = field(
        default_factory=dict, compare=False, repr=False
    )
    # A map from each `topic_part(id)` to the ids of the nodes that have this topic part
    nodes_by_topic_part: Mapping[str, tuple[str, ...]] = field(
        init=False, compare=False, repr=False
    )
    # For each role, the nodes with this `type`, sorted by id. The empty role has all nodes.
    nodes_by_role: Mapping[str, tuple[Node, ...]] = field(init=False, compare=False, repr=False)
    # For each `(capability,)` or `(label key, value)`, the nodes with it, sorted by id
    nodes_with: Mapping[tuple[str, ...], tuple[Node, ...]] = field(
        init=False, compare=False, repr=False
    )
    # For each property, the type of its value on most nodes, and the first node with this type
    property_kinds: Mapping[str, tuple[Kind, str]] = field(init=False, compare=False, repr=False)
    drained_nodes: tuple[str, ...] = field(init=False, compare=False, repr=False)
    limits_capacity: bool = field(init=False, compare=False, repr=False)
    # The input roles, sorted, that are the `root` of a service in at least one appdef
    roles_with_services: tuple[str, ...] = field(init=False, compare=False, repr=False)
    # The names of the services whose scaling has `downAfter`, in at least one appdef
    services_with_down_after: frozenset[str] = field(init=False, compare=False, repr=False)
    # For each appdef, a map from names of versions and channels to versions. The empty name stands
    # for the default version.
    application_versions: Mapping[str, Mapping[str, ApplicationVersion]] = field(
        init=False, compare=False, repr=False
    )

    def __post_init__(self) -> None:
        by_topic_part: dict[str, tuple[str, ...]] = {}
        by_kind: dict[str, dict[Kind, list[str]]] = {}
        for id, node in self.nodes.items():
            part = naming.topic_part(id)
            by_topic_part[part] = (*by_topic_part.get(part, ()), id)
            for name, value in node.properties.items():
                ids_by_kind = by_kind.setdefault(name, {})
                ids_by_kind.setdefault(kind_of(value) or "text", []).append(id)
        kinds = {
            name: max(ids_by_kind.items(), key=lambda kind_and_ids: len(kind_and_ids[1]))
            for name, ids_by_kind in by_kind.items()
        }
        by_role: dict[str, list[Node]] = {}
        by_trait: dict[tuple[str, ...], list[Node]] = {}
        for _, node in sorted(self.nodes.items()):
            for role in ("", node.type):
                by_role.setdefault(role, []).append(node)
            for trait in {*((name,) for name in node.capabilities), *node.labels().items()}:
                by_trait.setdefault(trait, []).append(node)
        services = [s for services in self.services.values() for s in services.values()]
        indexes = {
            "nodes_by_topic_part": by_topic_part,
            "nodes_by_role": {role: tuple(nodes) for role, nodes in by_role.items()},
            "nodes_with": {trait: tuple(nodes) for trait, nodes in by_trait.items()},
            "property_kinds": {name: (kind, ids[0]) for name, (kind, ids) in kinds.items()},
            "drained_nodes": tuple(sorted(id for id, node in self.nodes.items() if node.drained)),
            "limits_capacity": any(node.capacity is not None for node in self.nodes.values()),
            "services_with_down_after": frozenset(s.name for s in services if s.scaling.down_after),
            "roles_with_services": tuple(sorted({s.root for s in services if s.root})),
            "application_versions": {name: self._versions(name) for name in self.services},
        }
        for name, index in indexes.items():
            object.__setattr__(self, name, index)  # the class is frozen

    def _versions(self, appdef: str) -> dict[str, ApplicationVersion]:
        used = {service.chart for service in self.services[appdef].values()}
        charts = {name: chart for name, chart in self.charts.items() if name in used}

        def version(
            name: str, by_chart: Mapping[str, str], images: Mapping[str, ImagePin]
        ) -> ApplicationVersion:
            sources = {name: c.at(by_chart.get(name, "")) or c for name, c in charts.items()}
            return ApplicationVersion(appdef, name, sources, images)

        listed = self.versions.get(appdef)
        if listed is None:
            words = {"", *(word for chart in charts.values() for word in chart.versions())}
            # a chart that lacks a version or channel of another chart has its default
            return {word: version("", dict.fromkeys(charts, word), {}) for word in words}
        versions = {name: version(name, v.charts, v.images) for name, v in listed.versions.items()}
        channels = {"": listed.default, **listed.channels}
        return versions | {channel: versions[name] for channel, name in channels.items()}

    def host_of(self, node: str) -> str:
        """Return the inventory's name of a node: ``edge`` for ``edge@city``."""
        return self.hosts.get(node, node)

    def nodes_of(self, host: str) -> tuple[str, ...]:
        """Return a node's name in each of its access domains: ``edge``, then ``edge@city``."""
        node = self.nodes.get(host)
        domains = node.access_domains if node else ()
        return host, *(id_in_domain(host, domain.name) for domain in domains)

    def file_of(self, collection: str, name: str) -> str:
        """Return the file that has an entry; for an unknown entry, the collection's usual file."""
        return self.entry_files.get(collection, {}).get(name, collection)

    def place_of(self, collection: str) -> str:
        """Return the text by which messages name a collection's files."""
        return place_of_collection(collection, self.entry_files.get(collection, {}).values())

    def node_and_domain(self, id: str) -> tuple[Node, AccessDomain]:
        node, domain = self.nodes.get(id), self.domain_of.get(id)
        if node is None or domain is None:  # a person removed it while claims name it
            missing = self.place_of(NODES_FILE) if node is None else "any access domain"
            message = (
                f"'{id}' is in use, but not in {missing}; restore it there, or release all that "
                f"uses it: demandops decommission {shlex.quote(id)}"
            )
            file = NODES_FILE if node is None else DOMAINS_FILE
            raise Refused.at("node", message, code="unknown-node", file=file)
        return node, domain

    def appdef_by_wire_type(self, number: int) -> ApplicationDefinition | None:
        """Return the appdef that ``DeploymentRequest`` names by ``number``, or ``None``."""
        for appdef in self.appdefs.values():
            if appdef.deployment_request and appdef.deployment_request.type == number:
                return appdef
        return None

    def versions_of(self, appdef: str) -> list[str]:
        return sorted(self.application_versions[appdef].keys() - {""})

    def versions_file(self, appdef: str) -> str:
        """Return the text by which messages name the files that list the versions of an appdef."""
        if appdef in self.versions:
            return self.file_of(VERSIONS_FILE, appdef)
        return self.place_of(CHARTS_FILE)

    def users_of(self, service: str) -> list[str]:
        return [appdef for appdef, services in self.services.items() if service in services]

    def parameters_of(self, appdef: str) -> set[str]:
        services = self.services[appdef].values()
        return {
            *self.appdefs[appdef].parameters,
            *(name for s in services for name in s.parameters),
        }

    def values_template(self, service: Service) -> str:
        return f"appdefs/{service.folder}/{service.values}"
