"""How nodes reach each other, as the inventory tells it: brokers' TLS and secrets, Zenoh, DDS.

Nothing secret stands here: credentials and certificates are named by the Kubernetes Secret that
holds them, in the namespace of each access domain whose nodes use them.
"""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import Field, StringConstraints, model_validator

from generator.catalog.model import DnsLabel, Frozen

Host = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9]([A-Za-z0-9.:-]*[A-Za-z0-9])?$")]
"""A host name or an IP address."""

SecretKey = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]
"""A key inside a Kubernetes Secret; it becomes a file name."""

_ENDPOINT = re.compile(r"(tcp|udp|ws)/[^\s/#?]+:\d{1,5}")
Endpoint = Annotated[str, StringConstraints(pattern=f"^{_ENDPOINT.pattern}$")]
"""A Zenoh endpoint without certificates: ``tcp/host:7447``."""


class Tls(Frozen):
    """Encrypted connections to a broker; without ``caSecret`` the client image's own CAs count."""

    ca_secret: DnsLabel | None = Field(default=None, alias="caSecret")
    ca_key: SecretKey = Field(default="ca.crt", alias="caKey")


class Credentials(Frozen):
    """The Secret with a broker's user name and password, and the keys that they stand under."""

    secret: DnsLabel
    user_key: SecretKey = Field(default="username", alias="userKey")
    password_key: SecretKey = Field(default="password", alias="passwordKey")


class Zenoh(Frozen):
    """That a node runs a Zenoh bridge where a connection needs it, and how bridges meet.

    ``endpoint`` is where other nodes' bridges reach this one; ``listen`` where it listens for
    them, by default on the endpoint's port at every address; ``connect`` are routers that it
    always connects to. All may be left out: such a node connects to those that can be reached.
    """

    endpoint: Endpoint | None = None
    listen: tuple[Endpoint, ...] = Field(default=(), strict=False)
    connect: tuple[Endpoint, ...] = Field(default=(), strict=False)

    @model_validator(mode="after")
    def _reachable(self) -> Zenoh:
        if self.listen and not self.endpoint:
            raise ValueError("listen needs an endpoint, where others reach the node; add it")
        return self

    def listening(self) -> tuple[str, ...]:
        """Return the endpoints that the node's bridge listens on, none where nobody connects."""
        if self.listen or not self.endpoint:
            return self.listen
        protocol, _, address = self.endpoint.partition("/")
        return (f"{protocol}/0.0.0.0:{address.rpartition(':')[2]}",)


class Wan(Frozen):
    """Where DDS Routers on a node can be reached, one port for each ROS connection."""

    host: Host
    first_port: Annotated[int, Field(ge=1024, le=65535)] = Field(default=20000, alias="firstPort")
    last_port: Annotated[int, Field(ge=1024, le=65535)] = Field(default=29999, alias="lastPort")
    transport: Literal["tcp", "udp"] = "tcp"

    @model_validator(mode="after")
    def _some_ports(self) -> Wan:
        if self.last_port < self.first_port:
            raise ValueError(
                f"lastPort {self.last_port} is below firstPort {self.first_port}; swap them"
            )
        return self
