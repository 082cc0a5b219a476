"""What people wrote, as one value, and the reader that makes it of files."""

from __future__ import annotations

import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from demandops.base import errors, naming, strict_yaml
from demandops.base.errors import Fault, InvalidInput, Refused, fault, field_path, suggestion
from demandops.base.placeholders import glob_of, is_pattern
from demandops.model.config import registry
from demandops.model.config.appdef import (
    ApplicationDefinition,
    ServiceDefinition,
    Services,
)
from demandops.model.config.base_model import DnsLabel, faults_of, parse, parse_file
from demandops.model.config.entry_patterns import (
    EntryPattern,
    EntryPatterns,
    UnlistedNodes,
    may_match,
)
from demandops.model.config.inventory import Broker, Cluster, Kind, Node, id_in_domain, kind_of
from demandops.model.config.override import OVERRIDES_ROOT, Override
from demandops.model.config.policy import AccessDomain
from demandops.model.config.registry import ApplicationVersion, Chart, ClientsFile, Image, ImagePin
from demandops.model.config.repo_settings import RepoSettings

# ---- the whole configuration as one frozen, indexed value: :class:`Config` ----

# The collections of entries, each named by the file that usually lists its entries. Files in the
# folder `inventory/nodes/` may list further entries of the collection `inventory/nodes.yaml`, and
# likewise for the others (`collection_of`).
COLLECTIONS = (
    CLUSTERS_FILE := "inventory/clusters.yaml",
    NODES_FILE := "inventory/nodes.yaml",
    BROKERS_FILE := "inventory/brokers.yaml",
    DOMAINS_FILE := "policy/access-domains.yaml",
    CHARTS_FILE := "registry/charts.yaml",
    IMAGES_FILE := "registry/images.yaml",
    CLIENTS_FILE := "registry/clients.yaml",
    VERSIONS_FILE := "registry/versions.yaml",
)

# An entry of these may stand for each one whose id it matches (`entry_patterns`)
_WITH_PATTERNS = (NODES_FILE, BROKERS_FILE)

# The top-level entries of a state repo that hold the configuration, which people write
CONFIG_ROOTS = ("demandops.yaml", "inventory", "policy", "registry", "appdefs", OVERRIDES_ROOT)


def collection_of(path: str) -> str | None:
    folder, _, name = path.rpartition("/")
    if name.startswith(".") or not name.endswith(".yaml"):
        return None
    return next((file for file in (path, f"{folder}.yaml") if file in COLLECTIONS), None)


def place_of_collection(collection: str, files: Iterable[str]) -> str:
    # for example `inventory/nodes.yaml or inventory/nodes/`
    used = {file for file in {*files} if collection_of(file) == collection} or {collection}
    folder = [collection.replace(".yaml", "/")] if used - {collection} else []
    return " or ".join([collection] * (collection in used) + folder)


@dataclass(frozen=True, slots=True)
class Config:
    """What can run, where, and from which charts and images; most mappings are by name."""

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
    hosts: Mapping[str, str]
    # Since when its cluster no longer has a node that it had
    gone_since: Mapping[str, datetime]
    # Every override; `demandops.model.ledger.ledger.World` knows which of them have ended
    overrides: Mapping[str, Override]
    # The nodes and brokers whose id is a pattern
    node_patterns: EntryPatterns[Node]
    broker_patterns: EntryPatterns[Broker]
    unlisted: UnlistedNodes = field(compare=False, repr=False)
    clients: ClientsFile
    versions: Mapping[str, registry.VersionList]
    # For each collection, a map from each entry to the file that has the entry
    entry_files: Mapping[str, Mapping[str, str]] = field(compare=False, repr=False)
    # Each listed node, and those that stand for all nodes of a pattern, by the id as it is written
    kinds: Mapping[str, Node] = field(init=False, compare=False, repr=False)
    # For each `(capability,)` or `(label key, value)`, the nodes with it, sorted by id; for each
    # `("", role)`, those of this `type`, where the empty role has all nodes
    nodes_with: Mapping[tuple[str, ...], tuple[Node, ...]] = field(
        init=False, compare=False, repr=False
    )
    # For each property, the type of its value on most nodes, and the first node with this type
    property_kinds: Mapping[str, tuple[Kind, str]] = field(init=False, compare=False, repr=False)
    # The listed nodes that are drained, and whether all nodes of a pattern are
    drained_nodes: tuple[str, ...] = field(init=False, compare=False, repr=False)
    drains_patterns: bool = field(init=False, compare=False, repr=False)
    limits_capacity: bool = field(init=False, compare=False, repr=False)
    # The input roles, sorted, that are the `root` of a service in at least one appdef
    roles_with_services: tuple[str, ...] = field(init=False, compare=False, repr=False)
    # For each appdef, a map from names of versions and channels to versions. The empty name stands
    # for the default version.
    application_versions: Mapping[str, Mapping[str, ApplicationVersion]] = field(
        init=False, compare=False, repr=False
    )

    def __post_init__(self) -> None:
        examples = [pattern.example for pattern in self.node_patterns.values()]
        examples += [each.in_domain(at) for each in examples for at in each.access_domains]
        kinds_by_id = {**self.nodes, **{node.id: node for node in examples}}
        by_kind: dict[str, dict[Kind, list[str]]] = {}
        for node in kinds_by_id.values():
            for name, value in node.properties.items():
                ids_by_kind = by_kind.setdefault(name, {})
                ids_by_kind.setdefault(kind_of(value) or "text", []).append(node.id)
        kinds = {
            name: max(ids_by_kind.items(), key=lambda kind_and_ids: len(kind_and_ids[1]))
            for name, ids_by_kind in by_kind.items()
        }
        by_trait: dict[tuple[str, ...], list[Node]] = {}
        for _, node in sorted(self.nodes.items()):
            traits = {("", ""), ("", node.type), *((name,) for name in node.capabilities)}
            for trait in traits | node.labels.items():
                by_trait.setdefault(trait, []).append(node)
        services = [s for services in self.services.values() for s in services.values()]
        indexes = {
            "kinds": kinds_by_id,
            "nodes_with": {trait: tuple(nodes) for trait, nodes in by_trait.items()},
            "property_kinds": {name: (kind, ids[0]) for name, (kind, ids) in kinds.items()},
            "drained_nodes": tuple(id for id, node in self.nodes.items() if node.drained),
            "drains_patterns": any(node.drained for node in examples),
            "limits_capacity": any(node.capacity is not None for node in kinds_by_id.values()),
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

    def has_node(self, pattern: str) -> bool:
        """Return whether a node has this name, or may match this pattern with ``*`` and ``?``."""
        if "*" in pattern or "?" in pattern:
            return may_match(pattern, self.kinds)
        return pattern in self.nodes or pattern in self.kinds

    def why_no_node(self, id: str) -> str:
        """Say of an id that is no node why no pattern gives it, or what is nearly written so."""
        if problem := self.unlisted.why_not(id):
            return problem
        if id in self.kinds:
            return "is a pattern; name one that it matches"
        return f"is not in {self.place_of(NODES_FILE)}{suggestion(id, self.kinds)}"

    def usable_nodes(self) -> list[str]:
        """Return each listed node in an access domain, sorted, and then examples of patterns."""
        examples = (id for pattern in self.node_patterns.values() for id in pattern.example_ids())
        return [*sorted(self.domain_of), *(id for id in examples if id in self.domain_of)]

    def places_of(self, node: Node) -> list[tuple[str, AccessDomain]]:
        """Return a node's cluster and access domain, or each that nodes of a pattern may have."""
        if not is_pattern(node.id):
            return [(node.cluster, self.domain_of[node.id])] if node.id in self.domain_of else []
        host = node.id.partition("@")[0]
        return self.unlisted.places_by_id(self.node_patterns[host].example, self.clusters)[node.id]

    def domains_at(self, node: Node) -> list[AccessDomain]:
        return [*{domain.name: domain for _, domain in self.places_of(node)}.values()]

    def host_of(self, node: str) -> str:
        # `edge` for `edge@city`
        return self.hosts.get(node, node)

    def nodes_of(self, host: str) -> tuple[str, ...]:
        # `edge`, then `edge@city` for each further access domain
        node = self.nodes.get(host)
        domains = node.access_domains if node else ()
        return host, *(id_in_domain(host, domain.name) for domain in domains)

    def file_of(self, collection: str, name: str) -> str:
        # for an unknown entry, the collection's usual file
        if (file := self.entry_files[collection].get(name)) is not None:
            return file
        made_by = self.node_patterns.matching(name) if collection == NODES_FILE else []
        return made_by[0].file if made_by else collection

    def place_of(self, collection: str) -> str:
        return place_of_collection(collection, self.entry_files[collection].values())

    def node_and_domain(self, id: str) -> tuple[Node, AccessDomain]:
        node, domain = self.nodes.get(id), self.domain_of.get(id)
        if node is None or domain is None:  # a person removed it while claims name it
            missing = self.place_of(NODES_FILE) if node is None else "any access domain"
            what = self.unlisted.why_not(id) or f"not in {missing}; restore it there"
            message = (
                f"'{id}' is in use, but {what}, or release all that uses it: "
                f"demandops decommission {shlex.quote(id)}"
            )
            file = NODES_FILE if node is None else DOMAINS_FILE
            raise Refused.at("node", message, code="unknown-node", file=file)
        return node, domain


# ---- the reader: item by item, to find the faults of every item ----

Model = TypeVar("Model", bound=BaseModel)
Valid = TypeVar("Valid")

_NAME = TypeAdapter(DnsLabel)


class ConfigReader:
    def __init__(self, files: Mapping[str, str]) -> None:
        self.files = files
        self.faults: list[Fault] = []
        self._counts = Counter[str]()
        self.files_of = defaultdict[str | None, list[str]](list)  # by collection
        for path in sorted(files):
            self.files_of[collection_of(path)].append(path)
        # The file and the path of each item, by collection and name
        self.places: dict[str, dict[str, tuple[str, str]]] = {name: {} for name in COLLECTIONS}
        # The collections with items that are not valid
        self.incomplete: set[str] = set()
        # The valid entries whose id is a pattern, by collection
        self.patterns = defaultdict[str, list[EntryPattern[Any]]](list)
        # For each cluster that says which nodes it has, what these have besides
        self.of_clusters: list[EntryPattern[Node]] = []
        # The discovered nodes that their clusters no longer have, since when
        self.gone_since: dict[str, datetime] = {}
        # The valid files with items, but without the items
        self.heads: dict[str, BaseModel] = {}
        # By collection: why an id that a pattern matches is no entry, or nothing
        self.why_not = defaultdict[str, Callable[[str], str]](lambda: lambda name: "")

    def add_fault(self, file: str, field: str, message: str) -> None:
        self._counts[file] += 1
        self.faults.append(fault(field, message).within(file))

    def read_file(self, file: str, model: type[Model]) -> Model | None:
        text = self.files.get(file)
        if text is None:
            self.add_fault(file, "", "is missing; `demandops init` creates an example")
            return None
        try:
            return parse_file(model, text, file)
        except InvalidInput as error:
            self.faults += error.faults
            return None

    def read_items(
        self, collection: str, whole: type[BaseModel], field: str, item: type[Model], key: str = ""
    ) -> dict[str, Model]:
        """Return the valid items of a collection, by name; collect the faults of invalid ones.

        ``field`` of ``whole`` has the items: a list if ``key`` names the field with an item's name,
        else a mapping.
        """
        items: dict[str, Model] = {}
        places = self.places[collection]
        kind: type[Any] = list if key else dict
        for file in self.files_of[collection] or [collection]:
            entries: Any = None
            try:
                data = strict_yaml.load(self.files.get(file, ""), file)
                raw = data.get(field) if isinstance(data, dict) else None
                if isinstance(raw, kind):
                    entries = raw
                    # without the items, each of which is parsed below, so that an invalid item
                    # hides neither the others nor the faults of the file's other fields
                    self.heads[file] = parse(whole, {**data, field: kind()}, file)
                else:
                    self.read_file(file, whole)
            except InvalidInput as error:
                self.faults += error.faults
            if entries is None:
                self.incomplete.add(collection)
                continue
            for place, entry in enumerate(entries) if key else entries.items():
                name: Any = place
                if key:
                    name = entry.get(key) if isinstance(entry, dict) else None
                    name = naming.one_form(name) if isinstance(name, str) else None
                at = (field, place)
                if isinstance(name, str) and name in places:
                    self.add_duplicate(name, places[name], (file, field_path(at)), key)
                    continue
                if collection in _WITH_PATTERNS and is_pattern(name):
                    pattern = EntryPattern(name, key, item, entry, file, at)
                    places[name] = (file, field_path(at))
                    try:
                        _ = pattern.example  # so that its faults are those of the file
                        self.patterns[collection].append(pattern)
                    except InvalidInput as error:
                        self.faults += error.faults
                        self.incomplete.add(collection)
                    continue
                parsed = self._valid(item.model_validate, entry, item, file, at)
                label = key or self._valid(_NAME.validate_python, name, item, file, at)
                if parsed is None or label is None:
                    self.incomplete.add(collection)
                else:
                    items[name], places[name] = parsed, (file, field_path(at))
        return items

    def add_duplicate(
        self, name: str, first: tuple[str, str], second: tuple[str, str], key: str = ""
    ) -> None:
        dot_key = f".{key}" if key else ""
        if first[0] == second[0]:
            self.add_fault(
                second[0], f"{second[1]}{dot_key}", f"'{name}' appears twice; remove one"
            )
            return
        # both files, because the fault may be in either
        for (file, place), (other, _) in ((first, second), (second, first)):
            self.add_fault(file, f"{place}{dot_key}", f"'{name}' is in {other} too; remove one")

    def is_missing(self, collection: str, name: str, of: str = "") -> bool:
        """Return whether no entry has the name, which an entry with the id ``of`` may give."""
        if collection in self.incomplete:
            return False  # an invalid item may be the missing one, and has faults of its own
        if is_pattern(name):  # what is no pattern itself names one
            return not is_pattern(of) or not may_match(glob_of(name), self.places[collection])
        return name not in self.places[collection] and not any(
            pattern.values(name) for pattern in self.patterns[collection]
        )

    def check_reference(
        self, file: str, field: str, name: str, collection: str, of: str = ""
    ) -> None:
        if self.is_missing(collection, name, of):
            where = place_of_collection(collection, self.files_of[collection])
            where = where.replace("inventory/", "")
            # thousands of names may be unknown, and only the first faults of a file are listed
            is_listed = self._counts[file] < errors.MOST_FAULTS
            hint = suggestion(name, self.places[collection]) if is_listed else ""
            message = f"'{name}' is not in {where}{hint}"
            if name in self.places[collection]:
                message = f"'{name}' is a pattern; name one that it matches"
            self.add_fault(file, field, message)
        elif name not in self.places[collection] and (why := self.why_not[collection](name)):
            self.add_fault(file, field, f"'{name}' {why}")

    def _valid(
        self,
        validate: Callable[[Any], Valid],
        value: object,
        model: type[BaseModel],
        file: str,
        place: tuple[int | str, ...],
    ) -> Valid | None:
        try:
            return validate(value)
        except ValidationError as error:
            self.faults += faults_of(error, model, file, place)
            return None
