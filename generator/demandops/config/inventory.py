"""The inventory: nodes, clusters and brokers.

A node is a vehicle, a roadside station, an edge or a cloud server, or anything else that runs
services. A node belongs to one cluster. It runs services only in access domains: in the one whose
patterns match it, and in those that it lists. A node selector identifies the node in its cluster.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, StringConstraints, model_validator

from demandops.config.base_model import (
    CamelModel,
    DnsLabel,
    FileModel,
    Items,
    Text,
    Visible,
    Word,
    readable_by,
    without,
)
from demandops.config.node_property import PropertyName, PropertyValue
from demandops.identifiers import id_problem, message_type_problem, topic_problem
from demandops.quoting import quoted

Host = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9]([A-Za-z0-9.:-]*[A-Za-z0-9])?$")]

# A key in a Kubernetes Secret; in the pod, the key is a file's name
SecretKey = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]

_ENDPOINT = re.compile(r"(tcp|udp|ws)/[^\s/#?]+:\d{1,5}")
# A Zenoh endpoint whose protocol needs no certificates, like `tcp/host:7447`
Endpoint = Annotated[str, StringConstraints(pattern=f"^{_ENDPOINT.pattern}$"), Visible]


class Tls(CamelModel):
    """TLS to a broker. Without ``caSecret``, the client trusts the CAs that its image trusts."""

    ca_secret: DnsLabel | None = None
    ca_key: SecretKey = "ca.crt"


class Credentials(CamelModel):
    """The Secret with a broker's user name and password, and the keys of both in the Secret."""

    secret: DnsLabel
    user_key: SecretKey = "username"
    password_key: SecretKey = "password"  # noqa: S105 - the name of a key


class Zenoh(CamelModel):
    """The Zenoh bridge that a node runs when a connection needs it.

    Other nodes' bridges connect to ``endpoint``. The bridge listens at ``listen``, by default on
    the endpoint's port at every IPv4 address. It always connects to the routers in ``connect``. If
    none of these fields is given, the bridge only connects to bridges that have an endpoint.
    """

    endpoint: Endpoint | None = None
    listen: Items[Endpoint] = ()
    connect: Items[Endpoint] = ()

    @model_validator(mode="after")
    def _reachable(self) -> Zenoh:
        if self.listen and not self.endpoint:
            raise ValueError(
                "'listen' needs 'endpoint', the address at which other bridges reach this one; "
                "add 'endpoint'"
            )
        return self

    def listening(self) -> tuple[str, ...]:
        """Return the endpoints that the bridge listens on; empty if no other bridge can connect."""
        if self.listen or not self.endpoint:
            return self.listen
        protocol, _, address = self.endpoint.partition("/")
        return (f"{protocol}/0.0.0.0:{address.rpartition(':')[2]}",)


class Wan(CamelModel):
    """The address of a node's DDS Routers, with one port for each ROS connection."""

    host: Host
    first_port: Annotated[int, Field(ge=1024, le=65535)] = 20000
    last_port: Annotated[int, Field(ge=1024, le=65535)] = 29999
    transport: Literal["tcp", "udp"] = "tcp"

    @model_validator(mode="after")
    def _some_ports(self) -> Wan:
        if self.last_port < self.first_port:
            raise ValueError(
                f"lastPort {self.last_port} is below firstPort {self.first_port}; swap them"
            )
        return self


_QUANTITY = re.compile(r"(\d{1,15})(?:\.(\d{1,3}))?(m|k|M|G|T|Ki|Mi|Gi|Ti)?")
_FACTORS = {"m": 1, "": 1000} | {
    unit: 1000 * base**power
    for base, units in ((1000, ("k", "M", "G", "T")), (1024, ("Ki", "Mi", "Gi", "Ti")))
    for power, unit in enumerate(units, 1)
}


@lru_cache(maxsize=1024)
def amount_of(text: str) -> int:
    """Return a quantity of a resource in thousandths: 500 for ``500m``, 2000 for ``2``.

    Of Kubernetes' notations, exponents and the units above Ti are refused, with a ValueError.
    """
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise ValueError(f"{quoted(text)} is not a quantity; write one like 2, 500m, 1.5 or 16Gi")
    whole, decimals, unit = match.groups(default="")
    amount, remainder = divmod(int(whole + decimals.ljust(3, "0")) * int(_FACTORS[unit]), 1000)
    if remainder:
        raise ValueError(f"{quoted(text)} is finer than a thousandth; round it")
    return amount


def amount_text(amount: int, resource: str) -> str:
    """Return ``amount``, a number of thousandths, as people write it: ``1.5``, ``16Gi``."""
    if resource.endswith(("memory", "storage")):
        for unit in ("Ti", "Gi", "Mi", "Ki"):
            if amount and amount % _FACTORS[unit] == 0:
                return f"{amount // _FACTORS[unit]}{unit}"
    whole, decimals = divmod(amount, 1000)
    return f"{whole}.{decimals:03}".rstrip("0") if decimals else str(whole)


def _plain_number(value: object) -> object:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return str(value) if is_number else value


# A quantity as Kubernetes writes it, like `500m`. A plain number needs no quotes.
Quantity = Annotated[
    str,
    BeforeValidator(_plain_number, json_schema_input_type=str | int | float),
    readable_by(amount_of),
]

# A name of a resource: `cpu`, `memory`, `gpu`, `nvidia.com/gpu`
ResourceName = Annotated[
    str, StringConstraints(pattern=r"^([a-z0-9.-]+/)?[a-z][a-z0-9_.-]*$", max_length=120)
]

# How much of each resource a node has, or a service requests
Resources = dict[ResourceName, Quantity]

NodeId = Annotated[str, without(id_problem)]
Topic = Annotated[str, without(topic_problem)]
MessageType = Annotated[str, without(message_type_problem)]

# The label that selects a node by its id, as in the reference
NODE_LABEL = "node_id"

LabelKey = Annotated[
    str,
    StringConstraints(pattern=r"^([a-z0-9.-]+/)?[A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?$"),
]
_LABEL_VALUE = re.compile(r"([A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?)?")
LabelValue = Annotated[str, StringConstraints(pattern=f"^{_LABEL_VALUE.pattern}$")]


class Cluster(CamelModel):
    """A Kubernetes cluster whose GitOps controller reads ``clusters/<name>/``."""

    name: DnsLabel
    description: Text = ""


class Toleration(CamelModel):
    """A taint that workloads on the node tolerate (Kubernetes core/v1 Toleration)."""

    key: Text = ""
    operator: Literal["Exists", "Equal"] = "Equal"
    value: Text = ""
    effect: Literal["", "NoSchedule", "PreferNoSchedule", "NoExecute"] = ""

    @model_validator(mode="after")
    def _sensible(self) -> Toleration:
        if self.operator == "Exists" and self.value:
            raise ValueError("operator Exists takes no value; remove the value, or use Equal")
        if self.operator == "Equal" and not self.key:
            raise ValueError(
                "operator Equal needs a key; add a key, or use Exists to tolerate every taint"
            )
        return self


# A middleware of ROS. The word `image` stands for the middleware of the container's image.
Rmw = Literal["rmw_cyclonedds_cpp", "rmw_fastrtps_cpp", "rmw_connextdds", "rmw_zenoh_cpp", "image"]


# DDS computes its ports from the number; with a higher one they would be above 65535
RosDomainId = Annotated[int, Field(ge=0, le=232)]


class Ros(CamelModel):
    """The settings that a container needs to join the node's ROS graph."""

    domain_id: RosDomainId = 0
    rmw: Rmw = "rmw_cyclonedds_cpp"


Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]


class Position(CamelModel):
    """Coordinates in metres, in the map frame that all positions of a state repo share."""

    x: Coordinate
    y: Coordinate


class FurtherDomain(CamelModel):
    """A further access domain of a node, besides the domain whose patterns match the node.

    For connections of this domain, ``zenoh`` and ``wan`` replace those of the node, because two
    programs cannot listen on one port.
    """

    name: DnsLabel
    zenoh: Zenoh | None = None
    wan: Wan | None = None


class Node(CamelModel):
    """A C-ITS entity that runs services.

    A demand may name the node, or say which ``type``, ``capabilities`` and ``properties`` a node
    must have (:mod:`demandops.plan.nodes.placement`).
    """

    id: NodeId
    # The role of the node; any word
    type: Word
    cluster: DnsLabel
    # By default `{node_id: <id>}`, the label that the reference uses
    selector: dict[LabelKey, LabelValue] | None = None
    # The node's usual topic for each input role. The names of releases and derived topics contain
    # the node's id. For a further topic of the node, these names also contain the topic.
    topics: dict[Word, Topic] = Field(default_factory=dict)
    tolerations: Items[Toleration] = ()
    image_pull_secrets: Items[DnsLabel] = ()
    host_network: bool = True
    # A ROS domain of the access domain replaces the ROS domain that is given here
    ros: Ros = Ros()
    zenoh: Zenoh | None = None
    # The address at which ROS connections reach the node
    wan: Wan | None = None
    # The message types of topics, for requests that give no type
    types: dict[Topic, MessageType] = Field(default_factory=dict)
    # For each other node, the topics that the initial deployment already carries to that node. The
    # topics keep their names. Connections skip these topics.
    bridged: dict[NodeId, Items[Topic]] = Field(default_factory=dict)
    capabilities: Items[Word] = ()
    properties: dict[PropertyName, PropertyValue] = Field(default_factory=dict)
    position: Position | None = None
    # The generator chooses no drained node, and moves away what it placed there
    drained: bool = False
    # What all services on the node may request together (`demandops.plan.nodes.capacity`)
    capacity: Resources | None = None
    # The node's further domains. For each further domain, the configuration has a node
    # `<id>@<domain>` (`in_domain`).
    access_domains: Items[FurtherDomain] = ()

    @model_validator(mode="after")
    def _findable(self) -> Node:
        if self.selector is None and not _LABEL_VALUE.fullmatch(self.id):
            raise ValueError(
                "the id is not a valid label value, so no node of the cluster can have it in the "
                "label node_id; choose an id of up to 63 letters, digits, '-', '_' and '.' with a "
                "letter or digit at both ends, or add a selector"
            )
        return self

    def labels(self) -> dict[str, str]:
        return dict(self.selector) if self.selector is not None else {NODE_LABEL: self.id}

    def in_domain(self, further: FurtherDomain) -> Node:
        # `zenoh` and `wan` are not the node's own, because two programs cannot listen on one port
        return self.model_copy(
            update={
                "id": id_in_domain(self.id, further.name),
                "selector": self.labels(),
                "zenoh": further.zenoh,
                "wan": further.wan,
                "bridged": {},
                "access_domains": (),
            }
        )

    def most(self, resource: str) -> int | None:
        """Return the node's capacity of a resource in thousandths; ``None`` means no limit."""
        if self.capacity is None:
            return None
        if resource in self.capacity:
            return amount_of(self.capacity[resource])
        # every node has cpu and memory, but a resource such as a GPU only if it is listed
        return None if resource in ("cpu", "memory") else 0


def id_in_domain(node: str, domain: str) -> str:
    return f"{node}@{domain}"


class Broker(CamelModel):
    """A message broker and the node that it runs on.

    If ``topic_prefix`` is given, every MQTT topic of a connection at this broker starts with
    ``topic_prefix`` and ``/``.
    """

    node: NodeId
    type: Literal["mqtt"] = "mqtt"
    host: Host
    port: Annotated[int, Field(ge=1, le=65535)] = 1883
    tls: Tls | None = None
    credentials: Credentials | None = None
    topic_prefix: (
        Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*$")] | None
    ) = None


class ClustersFile(FileModel):
    """``inventory/clusters.yaml``, and files of ``inventory/clusters/``."""

    kind: Literal["Clusters"]
    clusters: Items[Cluster]


class NodesFile(FileModel):
    """``inventory/nodes.yaml``, and files of ``inventory/nodes/``."""

    kind: Literal["Nodes"]
    nodes: Items[Node]


class BrokersFile(FileModel):
    """``inventory/brokers.yaml``, and files of ``inventory/brokers/``."""

    kind: Literal["Brokers"]
    brokers: Items[Broker]
