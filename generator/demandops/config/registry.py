"""The registry: where each chart and image comes from, and in which version.

A chart comes from a folder of the state repo (the default), from an OCI registry or from an HTTP
chart repository.
"""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import Field, StringConstraints, model_validator

from demandops.config.base_model import DnsLabel, FileModel, FrozenModel, Word

ChartVersion = Annotated[
    str, StringConstraints(pattern=r"^\d+\.\d+\.\d+(-[0-9A-Za-z.-]+)?$", max_length=40)
]


class ChartSource(FrozenModel):
    """A Helm chart in one version: exactly one of ``folder``, ``oci``, ``http`` says where."""

    version: ChartVersion
    folder: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_./-]*$")] | None = (
        None
    )
    oci: Annotated[str, StringConstraints(pattern=r"^oci://[^\s]+$")] | None = None
    http: Annotated[str, StringConstraints(pattern=r"^https?://[^\s]+$")] | None = None

    @model_validator(mode="after")
    def _one_source(self) -> ChartSource:
        given = [name for name in ("folder", "oci", "http") if getattr(self, name)]
        if len(given) != 1:
            raise ValueError(
                "needs exactly one of folder, oci and http"
                + (f", not {' and '.join(given)}" if given else "")
            )
        if re.search(r"://[^/\s]*@", self.http or self.oci or ""):
            raise ValueError(
                "must hold no user or password; give it to the GitOps controller as a Secret"
            )
        if self.folder and ".." in self.folder.split("/"):
            raise ValueError("folder must stay inside the state repo; remove '..'")
        return self


class Chart(ChartSource):
    """A Helm chart: the version that is taken by default, and others by channel.

    A demand may ask for a channel by its name, or for one of the versions.
    """

    channels: dict[Word, ChartSource] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _distinct(self) -> Chart:
        seen = {self.version: "the default"}
        for name, source in self.channels.items():
            other = seen.setdefault(source.version, f"channel '{name}'")
            if other != f"channel '{name}'":
                raise ValueError(
                    f"channels.{name} has version {source.version}, as {other} has; one version "
                    "is one chart, so give each its own"
                )
        return self

    def sources(self) -> tuple[ChartSource, ...]:
        """Return the chart in all its versions, the default first."""
        return (self, *self.channels.values())

    def at(self, version: str) -> ChartSource | None:
        """Return the chart of a channel or version, the default where it is empty, or nothing."""
        if not version:
            return self
        if version in self.channels:
            return self.channels[version]
        return next((source for source in self.sources() if source.version == version), None)

    def versions(self) -> tuple[str, ...]:
        """Return all that :meth:`at` knows."""
        return (*self.channels, *(source.version for source in self.sources()))


class Image(FrozenModel):
    """A container image, pinned by tag, by digest or by both (the digest then decides)."""

    repository: Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9._/:-]*$")]
    tag: (
        Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}$")] | None
    ) = None
    digest: Annotated[str, StringConstraints(pattern=r"^sha256:[0-9a-f]{64}$")] | None = None

    @model_validator(mode="after")
    def _pinned(self) -> Image:
        if not (self.tag or self.digest):
            raise ValueError("needs a tag or a digest; without one the image is not pinned")
        return self

    def parts(self) -> dict[str, str]:
        """Return repository, tag and digest as the charts take them (absent ones empty)."""
        return {"repository": self.repository, "tag": self.tag or "", "digest": self.digest or ""}

    def reference(self) -> str:
        """Return the image as one reference, by digest where one is given."""
        return (
            f"{self.repository}@{self.digest}" if self.digest else f"{self.repository}:{self.tag}"
        )


class ChartsFile(FileModel):
    """``registry/charts.yaml``."""

    kind: Literal["Charts"]
    charts: dict[DnsLabel, Chart]


class ImagesFile(FileModel):
    """``registry/images.yaml``."""

    kind: Literal["Images"]
    images: dict[DnsLabel, Image]
