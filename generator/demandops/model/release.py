"""A release: one service or one end of a connection, as it is to run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from demandops.connections.connection import Client
from demandops.model.config.appdef import Resource, Scope, Service
from demandops.model.config.config import CHARTS_FILE, VERSIONS_FILE, Config
from demandops.model.config.inventory import Node
from demandops.model.config.override import UNSHAPED, Shaping
from demandops.model.config.policy import AccessDomain
from demandops.model.config.registry import ApplicationVersion, ChartSource, Image
from demandops.model.demand.demand import InputTopic
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import Ledger


@dataclass(frozen=True, slots=True)
class Autoscaler:
    """A HorizontalPodAutoscaler, which chooses a number of replicas from ``min`` to ``max``."""

    min: int
    max: int
    targets: Mapping[Resource, int]  # the usage of each resource that it aims at, in percent

    def __str__(self) -> str:
        by = ", ".join(f"{name} {percent} %" for name, percent in self.targets.items())
        return f"{self.min} to {self.max} by an autoscaler ({by})"


def most_replicas(replicas: int | Autoscaler) -> int:
    return replicas.max if isinstance(replicas, Autoscaler) else replicas


# ---- releases: one for each service instance and each client ----


@dataclass(frozen=True, slots=True)
class ServiceKey:
    """The identity of one instance of a service.

    ``application`` is set if the service runs once for each application. ``source`` and ``topic``
    are set if the service runs once for each topic; then the applications that need the service on
    this node for this topic share the instance. If none of these is set, the applications that need
    the service on this node share the instance. With ``for_cluster``, the applications in the
    node's cluster share it. ``version`` is set if the service runs for each topic and belongs to an
    application that runs in a version of its own beside others (``versions: separate``).
    """

    service: str
    node: str
    application: str | None = None
    source: str | None = None
    topic: str | None = None
    version: str = ""
    for_cluster: bool = False

    @property
    def scope(self) -> Scope:
        if self.application is not None:
            return "application"
        if self.for_cluster:
            return "cluster"
        return "node" if self.source is None else "topic"


@dataclass(frozen=True, slots=True)
class ServiceRelease:
    """The desired state of one service instance: one Helm release."""

    key: ServiceKey
    name: str
    node: Node
    domain: AccessDomain
    service: Service
    version: ApplicationVersion
    chart: ChartSource  # that of `version`, unless an override pins another
    restarts: bool  # by changed `parameters`, if only the chart says what these do
    inputs: Mapping[str, tuple[InputTopic, ...]]
    outputs: Mapping[str, str]
    parameters: Mapping[str, object]
    replicas: int | Autoscaler
    applications: tuple[str, ...]
    requesters: tuple[str, ...]
    shaping: Shaping = UNSHAPED

    @property
    def autoscaler(self) -> Autoscaler | None:
        return self.replicas if isinstance(self.replicas, Autoscaler) else None

    @property
    def images(self) -> tuple[str, ...]:
        return self.service.images

    def image(self, name: str, config: Config) -> Image:
        image, pin = config.images[name], self.version.images.get(name)
        return self.shaping.image(name, pin.over(image) if pin else image)

    @property
    def description(self) -> str:
        for_whom = self.key.source or self.key.application
        what = f"{self.key.service} {self.key.version}".rstrip()
        return f"{what} on {self.node.id}" + (f" for {for_whom}" if for_whom else "")

    def facts(self) -> list[str]:
        # one fact a line, because a commit message shows the lines that changed
        return [
            *(f"{role} {t.topic}" for role, topics in self.inputs.items() for t in topics),
            *(f"{name} = {value}" for name, value in self.parameters.items()),
            f"replicas {self.replicas}",
            *([f"version {self.version.name}"] if self.version.name else []),
            f"chart {self.chart.version}",
            *(
                f"image {name} {pin.digest or pin.tag or pin.repository}"
                for name, pin in sorted(self.version.images.items())
                if name in self.images
            ),
        ]

    def shaping_entries(self, config: Config) -> Iterator[tuple[str, str, str]]:
        # (file, entry, what it decides); an empty entry stands for the whole file
        folder = f"appdefs/{self.service.folder}"
        entry = "" if self.service.shared else f"services.{self.key.service}"
        yield self.service.file, entry, "its definition"
        if self.service.place:
            yield self.service.file, f"{entry}.place".lstrip("."), "what its node must have"
        yield self.service.values, "", "its Helm values"
        if self.version.name:
            entry = f"applications.{self.version.appdef}.versions.{self.version.name}"
            yield config.file_of(VERSIONS_FILE, self.version.appdef), entry, "its version"
        chart, name = self.chart, self.service.chart
        where = chart.oci or chart.http or f"folder {chart.folder or f'{folder}/charts/{name}'}"
        file = config.file_of(CHARTS_FILE, name)
        yield file, f"charts.{name}", f"version {chart.version} from {where}"


Release = ServiceRelease | Client


def claims_of(release: Release, ledger: Ledger) -> tuple[Claim, ...]:
    if isinstance(release, ServiceRelease):
        return tuple(c for id in release.applications for c in ledger.application_claims(id))
    return tuple(c for id in release.connections for c in ledger.connection_claims(id))
