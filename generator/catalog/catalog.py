"""All that people configured, parsed, cross-checked and indexed: the :class:`Catalog`.

Pure: takes the texts of the state repo's files, gives one frozen value. A file set is taken whole
or refused whole, with every fault of every file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, Field, StringConstraints

from generator import yamlio
from generator.catalog.appdef import ApplicationDefinition, Service
from generator.catalog.inventory import (
    Broker,
    BrokersFile,
    Cluster,
    ClustersFile,
    Node,
    NodesFile,
)
from generator.catalog.model import DnsLabel, FileModel, Frozen
from generator.catalog.policy import AccessDomain, AccessDomainsFile, matches
from generator.catalog.reading import Reading
from generator.catalog.registry import Chart, ChartsFile, ChartSource, Image, ImagesFile
from generator.errors import InvalidInput, near
from generator.settings import API_VERSION, RENDER_VERSION

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

ZENOH_BRIDGE_IMAGE = "zenoh-bridge"
"""The image of the registry that carries a node's Zenoh connections."""

DDS_ROUTER_IMAGE = "dds-router"
"""The image of the registry that both ends of a ROS connection run."""

_CONNECTION_PREFIXES = ("mqtt", "zenoh", "ros")

CONFIG_ROOTS = ("demandops.yaml", "inventory", "policy", "registry", "appdefs")
"""The top-level entries of a state repo that people own and the catalog is made from."""


GitUrl = Annotated[
    str, StringConstraints(pattern=r"^(https?|ssh)://[^\s:@]+(@[^\s:@]+)?(:\d+)?/\S+$")
]


class Flux(Frozen):
    """How the clusters' Flux reaches this repo: the GitRepository of each access domain."""

    url: GitUrl
    interval: Annotated[
        str, StringConstraints(pattern=r"^(\d+h)?(\d+m)?(\d+s)?$", min_length=2)
    ] = "1m"
    secret: DnsLabel | None = None


class ArgoCd(Frozen):
    """How the clusters' Argo CD reaches this repo, and the namespace it runs in.

    Credentials are Argo CD's own: a Secret of that namespace that names the URL.
    """

    url: GitUrl
    namespace: DnsLabel = "argocd"


class Repository(FileModel):
    """``demandops.yaml``: what the whole state repo has in common.

    The section of the controller that is not chosen may stand there too, and waits.
    """

    kind: Literal["StateRepository"]
    gitops: Literal["flux", "argocd"]
    render_version: int = Field(alias="renderVersion", ge=1)
    source: DnsLabel = "demandops"
    flux: Flux | None = None
    argocd: ArgoCd | None = None


_ANY = Repository(
    apiVersion=API_VERSION,
    kind="StateRepository",
    gitops="flux",
    renderVersion=RENDER_VERSION,
    flux=Flux(url="https://unread.invalid/repo.git"),
)  # stands in for one that could not be read, so that the rest is checked all the same


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

    def versions_of(self, appdef: str) -> list[str]:
        """Return the channels and versions that a demand for an application may name."""
        charts = {service.chart for service in self.appdefs[appdef].services.values()}
        return sorted({known for chart in charts for known in self.charts[chart].versions()})

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
    reading = Reading(files)
    repository = reading.one(ROOT_FILE, Repository)
    if repository and repository.render_version > RENDER_VERSION:
        reading.tell(
            ROOT_FILE,
            "renderVersion",
            f"is {repository.render_version}, but this generator renders version "
            f"{RENDER_VERSION}; update the generator",
        )
    if repository and getattr(repository, repository.gitops) is None:
        reading.tell(
            ROOT_FILE,
            repository.gitops,
            f"is missing, but gitops is {repository.gitops}; add it with the url that the "
            "clusters fetch this repo from",
        )
    nodes = reading.listed(NODES_FILE, NodesFile, "nodes", Node, "id")
    domains = reading.listed(DOMAINS_FILE, AccessDomainsFile, "domains", AccessDomain, "name")
    catalog = Catalog(
        repository=repository or _ANY,
        clusters=reading.listed(CLUSTERS_FILE, ClustersFile, "clusters", Cluster, "name"),
        nodes=nodes,
        brokers=reading.listed(BROKERS_FILE, BrokersFile, "brokers", Broker, "node"),
        domains=domains,
        charts=reading.named(CHARTS_FILE, ChartsFile, "charts", Chart),
        images=reading.named(IMAGES_FILE, ImagesFile, "images", Image),
        appdefs=_read_appdefs(reading),
        domain_of=_domains_of_nodes(reading, nodes, domains),
        files=MappingProxyType({p: text for p, text in files.items() if p.startswith("appdefs/")}),
    )
    cross_check(catalog, reading)
    if reading.faults:
        raise InvalidInput(dict.fromkeys(reading.faults))
    return catalog


def _read_appdefs(reading: Reading) -> Mapping[str, ApplicationDefinition]:
    appdefs = {}
    for path in sorted(reading.files):
        parts = path.split("/")
        if len(parts) != 3 or parts[0] != "appdefs" or parts[2] != "appdef.yaml":
            continue
        appdef = reading.one(path, ApplicationDefinition)
        if appdef is None:
            continue
        if appdef.name != parts[1]:
            reading.tell(
                path, "name", f"is '{appdef.name}', but the folder is '{parts[1]}'; make them one"
            )
            appdef = appdef.model_copy(update={"name": parts[1]})
        appdefs[appdef.name] = appdef
    return MappingProxyType(appdefs)


def _domains_of_nodes(
    reading: Reading, nodes: Mapping[str, Node], domains: Mapping[str, AccessDomain]
) -> Mapping[str, AccessDomain]:
    owner: dict[str, AccessDomain] = {}
    for node in nodes:
        matching = [d for d in domains.values() if matches(node, d.nodes)]
        if len(matching) > 1:
            names = " and ".join(f"'{domain.name}'" for domain in matching)
            reading.tell(
                NODES_FILE,
                f"nodes[{reading.place(NODES_FILE, node)}].id",
                f"'{node}' is in the access domains {names}; narrow their patterns so that it is "
                "in one",
            )
        elif matching:
            owner[node] = matching[0]
    return MappingProxyType(owner)


def cross_check(catalog: Catalog, reading: Reading) -> None:
    """Note every fault that shows only between files or entries."""
    for check in (
        _check_inventory,
        _check_topics,
        _check_namespaces,
        _check_controllers_namespace,
        _check_charts,
        _check_services,
        _check_wire_types,
        _check_clients,
        _check_links,
    ):
        check(catalog, reading)


def _check_inventory(catalog: Catalog, reading: Reading) -> None:
    for node in catalog.nodes.values():
        if reading.lacks(CLUSTERS_FILE, node.cluster):
            reading.tell(
                NODES_FILE,
                f"nodes[{reading.place(NODES_FILE, node.id)}].cluster",
                f"'{node.cluster}' is not in clusters.yaml"
                + near(node.cluster, reading.names(CLUSTERS_FILE)),
            )
    for broker in catalog.brokers.values():
        if reading.lacks(NODES_FILE, broker.node):
            reading.tell(
                BROKERS_FILE,
                f"brokers[{reading.place(BROKERS_FILE, broker.node)}].node",
                f"'{broker.node}' is not in nodes.yaml"
                + near(broker.node, reading.names(NODES_FILE)),
            )


def _check_topics(catalog: Catalog, reading: Reading) -> None:
    roles = {role for appdef in catalog.appdefs.values() for role in appdef.inputs}
    for node in catalog.nodes.values() if roles else ():
        for role in node.topics:
            if role not in roles:
                reading.tell(
                    NODES_FILE,
                    f"nodes[{reading.place(NODES_FILE, node.id)}].topics.{role}",
                    f"'{role}' is an input of no application" + near(role, roles),
                )


def _check_namespaces(catalog: Catalog, reading: Reading) -> None:
    seen: dict[str, str] = {}
    for domain in catalog.domains.values():
        other = seen.setdefault(domain.namespace, domain.name)
        if other != domain.name:
            reading.tell(
                DOMAINS_FILE,
                f"domains[{reading.place(DOMAINS_FILE, domain.name)}].namespace",
                f"'{domain.namespace}' is the namespace of '{other}' already; give each its own",
            )


def _check_controllers_namespace(catalog: Catalog, reading: Reading) -> None:
    argocd = catalog.repository.argocd if catalog.repository.gitops == "argocd" else None
    for domain in catalog.domains.values():
        if argocd and domain.namespace == argocd.namespace:
            reading.tell(
                DOMAINS_FILE,
                f"domains[{reading.place(DOMAINS_FILE, domain.name)}].namespace",
                f"'{domain.namespace}' is Argo CD's own, where whoever may write an Application "
                "may do all that Argo CD may; choose another",
            )


def _check_charts(catalog: Catalog, reading: Reading) -> None:
    for name, chart in catalog.charts.items():
        _check_chart(f"charts.{name}", chart, catalog, reading)
        for channel, source in chart.channels.items():
            _check_chart(f"charts.{name}.channels.{channel}", source, catalog, reading)


def _check_chart(where: str, chart: ChartSource, catalog: Catalog, reading: Reading) -> None:
    if not chart.folder:
        return
    path = f"{chart.folder}/Chart.yaml"
    text = catalog.files.get(path)
    if text is None:
        message = f"'{path}' does not exist; mend the folder"
        reading.tell(CHARTS_FILE, f"{where}.folder", message)
        return
    try:
        metadata = yamlio.load(text)
    except InvalidInput as error:
        reading.faults += yamlio.faults_in(error, path)
        return
    version = metadata.get("version") if isinstance(metadata, dict) else None
    if version != chart.version:
        reading.tell(
            CHARTS_FILE,
            f"{where}.version",
            f"is {chart.version}, but {path} says {version}; make them one",
        )


def _check_services(catalog: Catalog, reading: Reading) -> None:
    prefixes: dict[str, tuple[str, str, Service]] = {}
    for appdef in catalog.appdefs.values():
        file = f"appdefs/{appdef.name}/appdef.yaml"
        for name, service in appdef.services.items():
            where = f"services.{name}"
            if reading.lacks(CHARTS_FILE, service.chart):
                known = near(service.chart, reading.names(CHARTS_FILE))
                reading.tell(
                    file, f"{where}.chart", f"'{service.chart}' is not in {CHARTS_FILE}{known}"
                )
            for image in service.images:
                if reading.lacks(IMAGES_FILE, image):
                    known = near(image, reading.names(IMAGES_FILE))
                    reading.tell(
                        file, f"{where}.images", f"'{image}' is not in {IMAGES_FILE}{known}"
                    )
            if catalog.values_template(appdef.name, service) not in catalog.files:
                message = f"'{service.values}' does not exist; add it beside appdef.yaml"
                reading.tell(file, f"{where}.values", message)
            if service.prefix in _CONNECTION_PREFIXES:
                message = f"'{service.prefix}' names connections; choose another"
                reading.tell(file, f"{where}.prefix", message)
                continue
            other = prefixes.setdefault(service.prefix, (appdef.name, name, service))
            if other[2] is not service and not _same(catalog, other, (appdef.name, name, service)):
                reading.tell(
                    file,
                    f"{where}.prefix",
                    f"'{service.prefix}' is used by '{other[1]}' already; only a service for each "
                    "topic may stand in several appdefs, and then must be the same in all",
                )


def _same(catalog: Catalog, one: tuple[str, str, Service], other: tuple[str, str, Service]) -> bool:
    """Tell whether two appdefs mean the same shared service."""
    texts = [
        catalog.files.get(catalog.values_template(appdef, service))
        for appdef, _, service in (one, other)
    ]
    return bool(one[2].each) and one[1:] == other[1:] and texts[0] == texts[1]


def _check_clients(catalog: Catalog, reading: Reading) -> None:
    if catalog.brokers and reading.lacks(IMAGES_FILE, MQTT_CLIENT_IMAGE):
        message = f"'{MQTT_CLIENT_IMAGE}' is missing; MQTT connections run it"
        reading.tell(IMAGES_FILE, "images", message)


def _check_links(catalog: Catalog, reading: Reading) -> None:
    hosts: dict[tuple[object, ...], str] = {}
    for node in catalog.nodes.values():
        where = f"nodes[{reading.place(NODES_FILE, node.id)}]"
        for peer in node.bridged:
            if reading.lacks(NODES_FILE, peer):
                known = near(peer, reading.names(NODES_FILE))
                message = f"'{peer}' is not in nodes.yaml{known}"
                reading.tell(NODES_FILE, f"{where}.bridged.{peer}", message)
        if node.zenoh is None:
            continue
        host = (node.cluster, node.ros.domain_id, *sorted(node.labels().items()))
        other = hosts.setdefault(host, node.id)
        if other != node.id:
            reading.tell(
                NODES_FILE,
                f"{where}.zenoh",
                f"'{other}' runs a bridge on the same host and ROS domain, and two do not work; "
                "keep one",
            )


def _check_wire_types(catalog: Catalog, reading: Reading) -> None:
    seen: dict[int, str] = {}
    for appdef in catalog.appdefs.values():
        if appdef.deployment_request is None:
            continue
        number = appdef.deployment_request.type
        other = seen.setdefault(number, appdef.name)
        if other != appdef.name:
            reading.tell(
                f"appdefs/{appdef.name}/appdef.yaml",
                "deploymentRequest.type",
                f"{number} already names '{other}'; choose another number",
            )
