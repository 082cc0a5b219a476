"""The registry: sources and versions of charts, images and applications, and how clients run.

A chart is in a folder of the state repo, an OCI registry or an HTTP chart repository.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, StringConstraints, model_validator

from demandops.base import addresses
from demandops.base.errors import sentences, suggestion
from demandops.model.config import base_model, inventory
from demandops.model.config.base_model import CamelModel, DnsLabel, FileModel, FrozenModel
from demandops.model.config.inventory import Rmw

ChartVersion = Annotated[
    str, StringConstraints(pattern=r"^[0-9]+\.[0-9]+\.[0-9]+(-[0-9A-Za-z.-]+)?$", max_length=40)
]

ChartFolder = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_./-]*$")]

Repository = Annotated[str, base_model.readable_by(addresses.repository)]
Tag = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}$")]
Digest = Annotated[str, StringConstraints(pattern=r"^sha256:[0-9a-f]{64}$")]


class ChartSource(FrozenModel):
    """One version of a Helm chart; exactly one of ``folder``, ``oci``, ``http`` is its source."""

    version: ChartVersion
    folder: ChartFolder | None = None
    oci: Annotated[str, base_model.readable_by(addresses.oci_chart)] | None = None
    http: Annotated[str, base_model.readable_by(addresses.http_chart)] | None = None

    @model_validator(mode="after")
    def _one_source(self) -> ChartSource:
        given = [name for name in ("folder", "oci", "http") if getattr(self, name)]
        if len(given) != 1:
            raise ValueError(
                "needs exactly one of folder, oci and http"
                + (f", not {' and '.join(given)}" if given else "")
            )
        if self.folder and ".." in self.folder.split("/"):
            raise ValueError("'folder' must stay inside the state repo; remove '..'")
        return self


class Chart(ChartSource):
    """A Helm chart: its default version, and further versions, which a demand may request."""

    channels: dict[base_model.Word, ChartSource] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _distinct(self) -> Chart:
        seen = {self.version.lower(): "the default"}
        for name, source in self.channels.items():
            other = seen.setdefault(source.version.lower(), f"channel '{name}'")
            if other != f"channel '{name}'":
                raise ValueError(
                    f"channels.{name} and {other} have the same version, {source.version}; give "
                    "each its own, because a version names one chart, in capitals or not"
                )
        return self

    def sources(self) -> tuple[ChartSource, ...]:
        return (self, *self.channels.values())

    def at(self, version: str) -> ChartSource | None:
        if not version:  # the default
            return self
        if version in self.channels:
            return self.channels[version]
        return next((source for source in self.sources() if source.version == version), None)

    def versions(self) -> tuple[str, ...]:
        return (*self.channels, *(source.version for source in self.sources()))


class Image(FrozenModel):
    """A container image, pinned by tag or digest; if it has both, the digest counts."""

    repository: Repository
    tag: Tag | None = None
    digest: Digest | None = None

    @model_validator(mode="after")
    def _pinned(self) -> Image:
        if not (self.tag or self.digest):
            raise ValueError("needs a tag or a digest; without one the image is not pinned")
        return self

    def pulled_from(self, registry: str) -> Image:
        path = addresses.repository(self.repository).path
        return self.model_copy(update={"repository": f"{registry}/{path}"})

    def reference(self) -> str:
        return (
            f"{self.repository}@{self.digest}" if self.digest else f"{self.repository}:{self.tag}"
        )


class ChartsFile(FileModel):
    """``registry/charts.yaml``, and files of ``registry/charts/``."""

    kind: Literal["Charts"]
    charts: dict[DnsLabel, Chart]


class ImagesFile(FileModel):
    """``registry/images.yaml``, and files of ``registry/images/``."""

    kind: Literal["Images"]
    registry: Annotated[str, base_model.readable_by(addresses.registry)] | None = None
    images: dict[DnsLabel, Image]


class ImagePin(FrozenModel):
    """What a version or an override changes of an image; an absent field changes nothing.

    But a new tag removes the image's digest, and a new digest its tag (:meth:`over`).
    """

    repository: Repository | None = None
    tag: Tag | None = None
    digest: Digest | None = None

    @model_validator(mode="after")
    def _says_something(self) -> ImagePin:
        if not (self.repository or self.tag or self.digest):
            raise ValueError("changes nothing; give a tag, a digest or a repository")
        return self

    def over(self, image: Image) -> Image:
        # a digest would win over a new tag, and a tag would misname a new digest
        pins_anew = self.tag or self.digest
        return Image(
            repository=self.repository or image.repository,
            tag=self.tag if pins_anew else image.tag,
            digest=self.digest if pins_anew else image.digest,
        )


class VersionContents(CamelModel):
    """The charts and images of a version, where they are not the default ones."""

    charts: dict[DnsLabel, ChartVersion] = Field(default_factory=dict)
    images: dict[DnsLabel, ImagePin] = Field(default_factory=dict)


class VersionList(CamelModel):
    """The versions of one application definition, its default version, and its channels.

    A definition without this has no versions of its own: those of its charts count.
    """

    default: ChartVersion
    channels: dict[base_model.Word, ChartVersion] = Field(default_factory=dict)
    versions: dict[ChartVersion, VersionContents]

    @model_validator(mode="after")
    def _listed(self) -> VersionList:
        named = {"default": self.default} | {f"channels.{k}": v for k, v in self.channels.items()}
        problems = [
            f"{field}: '{version}' is not in versions{suggestion(version, self.versions)}"
            for field, version in named.items()
            if version not in self.versions
        ]
        if problems:
            raise ValueError(sentences(problems))
        return self


class VersionsFile(FileModel):
    """``registry/versions.yaml``, and files of ``registry/versions/``; a repo may have none."""

    kind: Literal["Versions"]
    applications: dict[DnsLabel, VersionList]


Precedence = tuple[tuple[int, ...], bool, tuple[tuple[bool, int, str], ...], str]


def precedence(version: str) -> Precedence:
    # by the rules of Semantic Versioning 2.0.0 (item 11)
    numbers, _, prerelease = version.partition("-")
    words = (
        (not word.isdigit(), int(word) if word.isdigit() else 0, word)
        for word in prerelease.split(".")
    )
    return tuple(map(int, numbers.split("."))), not prerelease, tuple(words), version


@dataclass(frozen=True)
class ApplicationVersion:
    """One version of an application definition, with its chart sources and image pins."""

    appdef: str
    name: str  # empty if `registry/versions.yaml` does not list the definition
    charts: Mapping[str, ChartSource]
    images: Mapping[str, ImagePin]

    @cached_property
    def rank(self) -> tuple[Precedence, ...]:
        # for comparison: equal ranks mean the same version
        # a definition without a list of versions is compared by the versions of its charts
        charts = (chart.version for _, chart in sorted(self.charts.items()))
        return tuple(map(precedence, [self.name] if self.name else charts))


_EnvName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
_LaunchFile = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.-]+$")]
_Package = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]*$")]


def _free(env: dict[str, str]) -> dict[str, str]:
    for name in ("ROS_DOMAIN_ID", "RMW_IMPLEMENTATION"):
        if name in env:
            raise ValueError(
                f"{name} follows from 'ros' of the node in the inventory; set 'ros' there, and "
                f"remove {name} here"
            )
    return env


class Resources(FrozenModel):
    """What a container requests, and its limits (Kubernetes core/v1 ResourceRequirements)."""

    requests: inventory.Resources = Field(default_factory=lambda: {"cpu": "50m", "memory": "64Mi"})
    limits: inventory.Resources = Field(default_factory=lambda: {"memory": "256Mi"})


class ClientSettings(CamelModel):
    """How the client containers of one connection type run; probes are as in Kubernetes."""

    env: Annotated[dict[_EnvName, base_model.Text], AfterValidator(_free)] = Field(
        default_factory=dict
    )
    resources: Resources = Resources()
    host_network: bool | None = None
    startup_probe: dict[str, Any] = Field(default_factory=dict)
    readiness_probe: dict[str, Any] = Field(default_factory=dict)
    liveness_probe: dict[str, Any] = Field(default_factory=dict)


class MqttClientSettings(ClientSettings):
    """The settings of MQTT clients, which are ROS nodes."""

    launch_file: _LaunchFile = "standalone.launch.xml"
    rmw: Rmw | None = None
    messages: base_model.Items[_Package] = ()


class ClientsFile(FileModel):
    """``registry/clients.yaml``, and files of ``registry/clients/``; a state repo may have none."""

    kind: Literal["Clients"]
    mqtt: MqttClientSettings = MqttClientSettings()
    zenoh: ClientSettings = ClientSettings()
    ros: ClientSettings = ClientSettings()
