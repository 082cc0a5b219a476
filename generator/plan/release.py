"""What planning gives: releases, one for each service instance and connection end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from generator.catalog.appdef import Service
from generator.catalog.inventory import Broker, Node
from generator.catalog.policy import AccessDomain
from generator.catalog.registry import ChartSource
from generator.demand.request import ConnectionType, InputTopic


@dataclass(frozen=True, slots=True)
class ServiceKey:
    """One instance of a service.

    ``application`` is set for a service that runs once for each application; ``source`` and
    ``topic`` for one that runs once for each topic and is shared by all who ask for it.
    """

    service: str
    node: str
    application: str | None = None
    source: str | None = None
    topic: str | None = None


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


@dataclass(frozen=True, slots=True)
class ConnectionEnd:
    """The desired state of one end of a connection: one communication client."""

    connection: str
    type: ConnectionType
    side: Literal["source", "target"]
    name: str
    node: Node
    peer: str
    domain: AccessDomain
    broker: Broker
    topics: Mapping[str, str]
    channel: str
    """What this connection's MQTT topics start with, the same at both ends."""


Release = ServiceRelease | ConnectionEnd
