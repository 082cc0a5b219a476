"""Releases: the plan's result, one for each service instance and communication client."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from demandops.config.appdef import Service
from demandops.config.config import Config
from demandops.config.inventory import Node
from demandops.config.override import Override
from demandops.config.policy import AccessDomain
from demandops.config.registry import ChartSource, Image
from demandops.connections.communication_client import Client
from demandops.demand.demand_request import InputTopic


@dataclass(frozen=True, slots=True)
class ServiceKey:
    """One instance of a service.

    ``application`` is set if the service runs once for each application. ``source`` and ``topic``
    are set if it runs once for each topic; all applications that use the topic share it.
    """

    service: str
    node: str
    application: str | None = None
    source: str | None = None
    topic: str | None = None


@dataclass(frozen=True, slots=True)
class Shaping:
    """The overrides that shape a release, with the effects of each; the last one wins."""

    by: tuple[tuple[Override, tuple[str, ...]], ...] = ()

    def image(self, image: str, config: Config) -> Image:
        """Return an image of the registry, with the pins of overrides."""
        found = config.images[image]
        for override, effects in self.by:
            if "images" in effects and override.images and image in override.images:
                found = override.images[image].over(found)
        return found

    @property
    def patches(self) -> tuple[tuple[str, Mapping[str, Any]], ...]:
        """The files that patch values, and their patches."""
        return tuple(
            (override.path, override.values or {})
            for override, effects in self.by
            if "values" in effects
        )

    @property
    def held(self) -> bool:
        """Whether a ``hold`` applies that no higher override changes, so the file stays."""
        held = False
        for _, effects in self.by:
            held = "hold" in effects or (held and set(effects) <= {"keep"})
        return held


UNSHAPED = Shaping()


@dataclass(frozen=True, slots=True)
class ServiceRelease:
    """The desired state of one service: one Helm release."""

    key: ServiceKey
    name: str
    node: Node
    domain: AccessDomain
    appdef: str
    service: Service
    chart: ChartSource
    inputs: Mapping[str, tuple[InputTopic, ...]]
    outputs: Mapping[str, str]
    parameters: Mapping[str, object]
    replicas: int
    applications: tuple[str, ...]
    requesters: tuple[str, ...]
    shaping: Shaping = UNSHAPED

    @property
    def images(self) -> tuple[str, ...]:
        """The registry's names of its images."""
        return self.service.images

    @property
    def description(self) -> str:
        """What it is, for commit messages."""
        return f"{self.key.service} on {self.node.id} for {self.key.source or self.key.application}"

    def facts(self) -> list[str]:
        """Return what people should know of it, one line each."""
        return [
            *(f"{role} {t.topic}" for role, topics in self.inputs.items() for t in topics),
            *(f"{name} = {value}" for name, value in self.parameters.items()),
            f"replicas {self.replicas}",
        ]


@dataclass(frozen=True, slots=True)
class ClientRelease:
    """The desired state of one communication client: one file of plain manifests."""

    client: Client
    shaping: Shaping = UNSHAPED

    @property
    def name(self) -> str:
        """The client's name."""
        return self.client.name

    @property
    def node(self) -> Node:
        """The node that it runs on."""
        return self.client.node

    @property
    def domain(self) -> AccessDomain:
        """The access domain of its node."""
        return self.client.domain

    @property
    def connections(self) -> tuple[str, ...]:
        """The connections that it carries."""
        return self.client.connections

    @property
    def images(self) -> tuple[str, ...]:
        """The registry's names of its images."""
        return (self.client.type.image,)

    @property
    def description(self) -> str:
        """What it is, for commit messages."""
        return self.client.description

    def facts(self) -> list[str]:
        """Return what people should know of it, one line each."""
        return self.client.facts()


Release = ServiceRelease | ClientRelease
