"""All that people configured, parsed, cross-checked and indexed: the :class:`Catalog`.

Pure: takes the texts of the state repo's files, gives one frozen value. A file set is taken whole
or refused whole, with every fault of every file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from types import MappingProxyType
from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, Field, StringConstraints

from generator import yamlio
from generator.catalog.appdef import ApplicationDefinition, Service
from generator.catalog.inventory import (
    AccessDomain,
    AccessDomainsFile,
    Broker,
    BrokersFile,
    Cluster,
    ClustersFile,
    Node,
    NodesFile,
)
from generator.catalog.model import DnsLabel, FileModel, Frozen, parse_file
from generator.catalog.registry import Chart, ChartsFile, Image, ImagesFile
from generator.errors import Fault, InvalidInput, fault, near
from generator.settings import RENDER_VERSION

Model = TypeVar("Model", bound=BaseModel)

ROOT_FILE = "demandops.yaml"
CLUSTERS_FILE = "inventory/clusters.yaml"
NODES_FILE = "inventory/nodes.yaml"
BROKERS_FILE = "inventory/brokers.yaml"
DOMAINS_FILE = "policy/access-domains.yaml"
CHARTS_FILE = "registry/charts.yaml"
IMAGES_FILE = "registry/images.yaml"

MQTT_CLIENT_IMAGE = "mqtt-client"
"""The image of the registry that both ends of an MQTT connection run."""

CONFIG_ROOTS = ("demandops.yaml", "inventory", "policy", "registry", "appdefs")
"""The top-level entries of a state repo that people own and the catalog is made from."""


class Flux(Frozen):
    """How the clusters' Flux reaches this repo: the GitRepository of each access domain."""

    url: Annotated[
        str, StringConstraints(pattern=r"^(https?|ssh)://[^\s:@]+(@[^\s:@]+)?(:\d+)?/\S+$")
    ]
    interval: Annotated[
        str, StringConstraints(pattern=r"^(\d+h)?(\d+m)?(\d+s)?$", min_length=2)
    ] = "1m"
    secret: DnsLabel | None = None


class Repository(FileModel):
    """``demandops.yaml``: what the whole state repo has in common."""

    kind: Literal["StateRepository"]
    gitops: Literal["flux"]
    render_version: int = Field(alias="renderVersion", ge=1)
    source: DnsLabel = "demandops"
    flux: Flux


@dataclass(frozen=True, slots=True)
class Catalog:
    """What can be run, where, from which charts and images.

    ``files`` keeps the texts that templates and chart schemas are read from, by path.
    """

    repository: Repository
    clusters: Mapping[str, Cluster]
    nodes: Mapping[str, Node]
    brokers: Mapping[str, Broker]
    domains: Mapping[str, AccessDomain]
    charts: Mapping[str, Chart]
    images: Mapping[str, Image]
    appdefs: Mapping[str, ApplicationDefinition]
    domain_of: Mapping[str, AccessDomain]
    files: Mapping[str, str]

    def appdef_by_wire_type(self, number: int) -> ApplicationDefinition | None:
        """Return the appdef that ``DeploymentRequest`` names by ``number``."""
        for appdef in self.appdefs.values():
            if appdef.deployment_request and appdef.deployment_request.type == number:
                return appdef
        return None

    def values_template(self, appdef: str, service: Service) -> str:
        """Return the path of the template that gives a service's Helm values."""
        return f"appdefs/{appdef}/{service.values}"


def load(files: Mapping[str, str]) -> Catalog:
    """Parse the configuration files of a state repo.

    Args:
        files: path in the state repo → text; files of other folders are passed over.

    Raises:
        InvalidInput: with every fault of every file.
    """
    faults: list[Fault] = []
    read = partial(_read, files, faults)
    repository = read(ROOT_FILE, Repository)
    clusters = read(CLUSTERS_FILE, ClustersFile)
    nodes = read(NODES_FILE, NodesFile)
    brokers = read(BROKERS_FILE, BrokersFile)
    domains = read(DOMAINS_FILE, AccessDomainsFile)
    charts = read(CHARTS_FILE, ChartsFile)
    images = read(IMAGES_FILE, ImagesFile)
    appdefs = _read_appdefs(files, faults)
    if repository and repository.render_version > RENDER_VERSION:
        faults.append(
            fault(
                "renderVersion",
                f"is {repository.render_version}, but this generator renders version "
                f"{RENDER_VERSION}; update the generator",
            ).within(ROOT_FILE)
        )
    if not (repository and clusters and nodes and brokers and domains and charts and images):
        raise InvalidInput(faults)

    catalog = Catalog(
        repository=repository,
        clusters=_keyed(clusters.clusters, "name", "clusters", CLUSTERS_FILE, faults),
        nodes=_keyed(nodes.nodes, "id", "nodes", NODES_FILE, faults),
        brokers=_keyed(brokers.brokers, "node", "brokers", BROKERS_FILE, faults),
        domains=_keyed(domains.domains, "name", "domains", DOMAINS_FILE, faults),
        charts=charts.charts,
        images=images.images,
        appdefs=appdefs,
        domain_of=_domains_of_nodes(nodes.nodes, domains.domains, faults),
        files=MappingProxyType({p: t for p, t in files.items() if p.startswith("appdefs/")}),
    )
    faults += _cross_check(catalog)
    if faults:
        raise InvalidInput(faults)
    return catalog


def _read(
    files: Mapping[str, str], faults: list[Fault], path: str, model: type[Model]
) -> Model | None:
    text = files.get(path)
    if text is None:
        faults.append(fault("", "is missing; `demandops init` shows what it holds").within(path))
        return None
    try:
        return parse_file(model, text, path)
    except InvalidInput as error:
        faults += error.faults
        return None


def _read_appdefs(
    files: Mapping[str, str], faults: list[Fault]
) -> Mapping[str, ApplicationDefinition]:
    appdefs = {}
    for path in sorted(files):
        parts = path.split("/")
        if len(parts) != 3 or parts[0] != "appdefs" or parts[2] != "appdef.yaml":
            continue
        appdef = _read(files, faults, path, ApplicationDefinition)
        if appdef is None:
            continue
        if appdef.name != parts[1]:
            faults.append(
                fault(
                    "name", f"is '{appdef.name}', but the folder is '{parts[1]}'; make them one"
                ).within(path)
            )
        appdefs[appdef.name] = appdef
    return MappingProxyType(appdefs)


def _keyed(
    items: Iterable[Model], key: str, field: str, file: str, faults: list[Fault]
) -> Mapping[str, Model]:
    found: dict[str, Model] = {}
    for index, item in enumerate(items):
        name = str(getattr(item, key))
        if name in found:
            faults.append(
                fault(f"{field}[{index}].{key}", f"'{name}' stands twice; remove one").within(file)
            )
        found[name] = item
    return MappingProxyType(found)


def _domains_of_nodes(
    nodes: Iterable[Node], domains: Iterable[AccessDomain], faults: list[Fault]
) -> Mapping[str, AccessDomain]:
    owner: dict[str, AccessDomain] = {}
    domains = list(domains)
    for index, node in enumerate(nodes):
        matching = [d for d in domains if any(fnmatchcase(node.id, p) for p in d.nodes)]
        if len(matching) > 1:
            names = " and ".join(f"'{domain.name}'" for domain in matching)
            faults.append(
                fault(
                    f"nodes[{index}].id",
                    f"'{node.id}' is in the access domains {names}; "
                    "narrow their patterns so that it is in one",
                ).within(NODES_FILE)
            )
        elif matching:
            owner[node.id] = matching[0]
    return MappingProxyType(owner)


def _cross_check(catalog: Catalog) -> list[Fault]:
    checks: tuple[Callable[[Catalog], Iterable[Fault]], ...] = (
        _check_inventory,
        _check_namespaces,
        _check_charts,
        _check_services,
        _check_wire_types,
        _check_clients,
    )
    return [found for check in checks for found in check(catalog)]


def _check_inventory(catalog: Catalog) -> Iterable[Fault]:
    for index, node in enumerate(catalog.nodes.values()):
        if node.cluster not in catalog.clusters:
            yield fault(
                f"nodes[{index}].cluster",
                f"'{node.cluster}' is not in clusters.yaml" + near(node.cluster, catalog.clusters),
            ).within(NODES_FILE)
    for index, broker in enumerate(catalog.brokers.values()):
        if broker.node not in catalog.nodes:
            yield fault(
                f"brokers[{index}].node",
                f"'{broker.node}' is not in nodes.yaml" + near(broker.node, catalog.nodes),
            ).within(BROKERS_FILE)


def _check_namespaces(catalog: Catalog) -> Iterable[Fault]:
    seen: dict[str, str] = {}
    for index, domain in enumerate(catalog.domains.values()):
        other = seen.setdefault(domain.namespace, domain.name)
        if other != domain.name:
            yield fault(
                f"domains[{index}].namespace",
                f"'{domain.namespace}' is the namespace of '{other}' already; give each its own",
            ).within(DOMAINS_FILE)


def _check_charts(catalog: Catalog) -> Iterable[Fault]:
    for name, chart in catalog.charts.items():
        if not chart.folder:
            continue
        path = f"{chart.folder}/Chart.yaml"
        where = f"charts.{name}.folder"
        text = catalog.files.get(path)
        if text is None:
            yield fault(where, f"'{path}' does not exist; mend the folder").within(CHARTS_FILE)
            continue
        try:
            metadata = yamlio.load(text)
            version = metadata.get("version") if isinstance(metadata, dict) else None
        except InvalidInput as error:
            yield from yamlio.faults_in(error, path)
            continue
        if version != chart.version:
            yield fault(
                f"charts.{name}.version",
                f"is {chart.version}, but {path} says {version}; make them one",
            ).within(CHARTS_FILE)


def _check_services(catalog: Catalog) -> Iterable[Fault]:
    prefixes: dict[str, tuple[str, Service]] = {}
    for appdef in catalog.appdefs.values():
        file = f"appdefs/{appdef.name}/appdef.yaml"
        for name, service in appdef.services.items():
            where = f"services.{name}"
            if service.chart not in catalog.charts:
                yield fault(
                    f"{where}.chart",
                    f"'{service.chart}' is not in {CHARTS_FILE}"
                    + near(service.chart, catalog.charts),
                ).within(file)
            for image in service.images:
                if image not in catalog.images:
                    yield fault(
                        f"{where}.images",
                        f"'{image}' is not in {IMAGES_FILE}" + near(image, catalog.images),
                    ).within(file)
            if catalog.values_template(appdef.name, service) not in catalog.files:
                yield fault(f"{where}.values", f"'{service.values}' does not exist").within(file)
            other, known = prefixes.setdefault(service.prefix, (name, service))
            if service.prefix in ("mqtt", "zenoh", "ros"):
                yield fault(
                    f"{where}.prefix", f"'{service.prefix}' names connections; choose another"
                ).within(file)
            elif other != name or (known is not service and not _same_service(known, service)):
                yield fault(
                    f"{where}.prefix",
                    f"'{service.prefix}' is used by '{other}' already; only a service for each "
                    "topic may stand in several appdefs, and then must be the same in all",
                ).within(file)


def _same_service(one: Service, other: Service) -> bool:
    return bool(one.each) and one == other


def _check_clients(catalog: Catalog) -> Iterable[Fault]:
    if catalog.brokers and MQTT_CLIENT_IMAGE not in catalog.images:
        yield fault("images", f"'{MQTT_CLIENT_IMAGE}' is missing; MQTT connections run it").within(
            IMAGES_FILE
        )


def _check_wire_types(catalog: Catalog) -> Iterable[Fault]:
    seen: dict[int, str] = {}
    for appdef in catalog.appdefs.values():
        if appdef.deployment_request is None:
            continue
        other = seen.setdefault(appdef.deployment_request.type, appdef.name)
        if other != appdef.name:
            yield fault(
                "deploymentRequest.type",
                f"{appdef.deployment_request.type} already names '{other}'; choose another number",
            ).within(f"appdefs/{appdef.name}/appdef.yaml")
