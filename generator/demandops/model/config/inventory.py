"""The inventory: nodes with their properties, clusters and brokers."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, lru_cache
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    StringConstraints,
    WithJsonSchema,
    model_validator,
)

from demandops.base import addresses, strict_yaml
from demandops.base.naming import id_problem, message_type_problem, topic_problem
from demandops.base.quantities import amount_of
from demandops.base.quoting import quoted
from demandops.model.config import base_model
from demandops.model.config.base_model import CamelModel, DnsLabel, FileModel, Items, Text, Word

# ---- properties of nodes: typed values, and the conditions of ``place`` on them ----
#
# A condition is a text: ``ros=jazzy``, ``memoryGiB>=8`` or ``memoryGiB<=64``. A property has values
# of the same type on all nodes. This type decides how the value in a condition is read.

_NAME = "[a-z][A-Za-z0-9_]*"
_TEXT = re.compile(r"[A-Za-z0-9]([A-Za-z0-9 ._+:/-]{0,61}[A-Za-z0-9])?")
_CONDITION = re.compile(rf"({_NAME})(>=|<=|=)(.+)")
_COMPARED: dict[str, Callable[[Any, Any], bool]] = {
    "=": operator.eq, ">=": operator.ge, "<=": operator.le,
}  # fmt: skip
_BOUNDS = {"min": ">=", "max": "<="}

# The name of a property; it includes the unit of the value, as in `memoryGiB`
PropertyName = Annotated[str, StringConstraints(pattern=f"^{_NAME}$", max_length=63)]

# The type of a property's values, in words
Kind = Literal["a number", "text", "true or false"]


class PropertyCondition(NamedTuple):
    name: str
    sign: str
    value: str


def kind_of(value: object) -> Kind | None:
    # None if no property may have this value
    match value:
        case bool():
            return "true or false"
        case int() | float():
            return "a number" if _number(value) is not None else None
        case str() if _TEXT.fullmatch(value):
            return "text"
    return None


def _value(value: object) -> object:
    if kind_of(value) is None:
        shown = strict_yaml.short_repr(value)
        raise ValueError(f"is {shown}; give a number, true, false, or a short plain text")
    return value


def _required_value(value: object) -> object:
    if not isinstance(value, dict):
        return _value(value)
    bounds = {*map(str, value)}
    if not bounds or bounds - _BOUNDS.keys():
        raise ValueError("give min, max or both, or a plain value")
    for bound in value.values():
        if kind_of(bound) != "a number":
            shown = strict_yaml.short_repr(bound)
            raise ValueError(f"has {shown} as a bound; give a number")
    if len(bounds) == 2 and value["min"] > value["max"]:
        raise ValueError("has a min above its max; lower min or raise max")
    return value


_PLAIN: list[dict[str, Any]] = [{"type": name} for name in ("number", "string", "boolean")]
_LIMITS: dict[str, Any] = {
    "title": "Bounds",
    "type": "object",
    "properties": {bound: {"type": "number"} for bound in _BOUNDS},
    "additionalProperties": False,
    "minProperties": 1,
}
PropertyValue = Annotated[Any, AfterValidator(_value), WithJsonSchema({"anyOf": _PLAIN})]
# The value that a definition requires of a property; for a number also bounds: `{min: 8}`
RequiredValue = Annotated[
    Any, AfterValidator(_required_value), WithJsonSchema({"anyOf": [*_PLAIN, _LIMITS]})
]


def condition_texts(properties: Mapping[str, object]) -> Iterator[str]:
    for name, value in properties.items():
        if isinstance(value, dict):
            yield from (f"{name}{_BOUNDS[bound]}{limit}" for bound, limit in value.items())
        else:
            yield f"{name}={str(value).lower() if isinstance(value, bool) else value}"


def comparable_kind(value: object) -> Kind | None:
    return "a number" if isinstance(value, dict) else kind_of(value)


@lru_cache(maxsize=1024)
def read_condition(text: str) -> PropertyCondition | None:
    match = _CONDITION.fullmatch(text)
    condition = PropertyCondition(*match.groups()) if match else None
    if condition and condition.sign != "=" and _number(condition.value) is None:
        return None
    return condition


def condition_problem(condition: PropertyCondition, kind: Kind) -> str:
    if _value_as(kind, condition) is not None:
        return ""
    return f"{quoted(condition.name)} is {kind}; ask for {_EXAMPLES[kind].format(condition.name)}"


_EXAMPLES: dict[Kind, str] = {
    "a number": "{0}=8, {0}>=8 or {0}<=8",
    "text": "{0}=word",
    "true or false": "{0}=true or {0}=false",
}


def meets_condition(properties: Mapping[str, object], text: str) -> bool:
    condition = read_condition(text)
    value = properties.get(condition.name) if condition else None
    kind = kind_of(value)
    required = _value_as(kind, condition) if condition and kind else None
    if required is None or condition is None:
        return False
    return _COMPARED[condition.sign](value, required)


def _value_as(kind: Kind, condition: PropertyCondition) -> object:
    if kind == "a number":
        return _number(condition.value)
    if condition.sign != "=":
        return None
    if kind == "text":
        return condition.value
    return {"true": True, "false": False}.get(condition.value)


def _number(value: str | float) -> float | None:
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None  # JSON, and so a chart, has no infinity


# ---- the inventory: nodes, clusters and brokers ----
#
# A node belongs to one cluster. It runs services only in access domains: in the one whose patterns
# match it, and in those that it lists. A node selector identifies the node in its cluster.

Host = Annotated[str, base_model.readable_by(addresses.host)]

# A key in a Kubernetes Secret; in the pod, the key is a file's name
SecretKey = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]

Endpoint = Annotated[str, base_model.readable_by(addresses.endpoint)]


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

    By default it listens on the endpoint's port at every IPv4 address, or every IPv6 address if the
    endpoint is one. Without any field, it only connects to bridges that have an endpoint.
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
        if self.listen or not self.endpoint:
            return self.listen
        protocol, host, port = addresses.endpoint(self.endpoint)
        everywhere = "[::]" if ":" in host else "0.0.0.0"  # noqa: S104
        return (f"{protocol}/{everywhere}:{port}",)


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


# A quantity as Kubernetes writes it, like `500m`. A plain number needs no quotes.
Quantity = Annotated[
    str,
    BeforeValidator(
        lambda value: str(value) if type(value) in (int, float) else value,
        json_schema_input_type=str | int | float,
    ),
    base_model.readable_by(amount_of),
]

# A name of a resource: `cpu`, `memory`, `gpu`, `nvidia.com/gpu`
ResourceName = Annotated[
    str, StringConstraints(pattern=r"^([a-z0-9.-]+/)?[a-z][a-z0-9_.-]*$", max_length=120)
]

# How much of each resource a node has, or a service requests
Resources = dict[ResourceName, Quantity]


def _node_id_problem(id: str) -> str:
    if "*" in id:
        return f"{quoted(id)} is no id; for a pattern, write {quoted(id.replace('*', '{n}', 1))}"
    return id_problem(id)


NodeId = Annotated[str, base_model.OneForm, base_model.without(_node_id_problem)]
Topic = Annotated[str, base_model.without(topic_problem)]
MessageType = Annotated[str, base_model.without(message_type_problem)]

# The label that selects a node by its id, as in the reference
NODE_LABEL = "node_id"

LabelKey = Annotated[
    str,
    StringConstraints(pattern=r"^([a-z0-9.-]+/)?[A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?$"),
]
_LABEL_VALUE = re.compile(r"([A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?)?")
LabelValue = Annotated[str, StringConstraints(pattern=f"^{_LABEL_VALUE.pattern}$")]


# What a cluster says itself of each node
_FROM_CLUSTER = ("id", "cluster", "selector", "drained")


class Discovery(CamelModel):
    """How the nodes of a cluster become nodes of the inventory (:mod:`.discovered`)."""

    # the labels of the nodes that are taken over, besides `node_id`, which has the id
    selector: dict[LabelKey, LabelValue] = Field(default_factory=dict)
    # for how long a node that the cluster no longer has stays, drained
    gone_after: Annotated[str, base_model.readable_by(base_model.seconds_of)] = "10m"
    # which label says what; `capability.demandops/<word>` and `property.demandops/<name>` always do
    type_label: LabelKey = "demandops/type"
    capability_labels: dict[Word, LabelKey] = Field(default_factory=dict)
    property_labels: dict[PropertyName, LabelKey] = Field(default_factory=dict)
    # what each of these nodes has besides, such as its topics; the texts may have `{id}`
    entry: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _complements(self) -> Discovery:
        for name in _FROM_CLUSTER:
            if name in self.entry:
                raise ValueError(f"'{name}' of 'entry' comes from the cluster; remove it")
        return self


class Cluster(CamelModel):
    """A Kubernetes cluster whose GitOps controller reads ``clusters/<name>/``."""

    name: DnsLabel
    description: Text = ""
    nodes: Literal["listed", "from-cluster"] = "listed"
    discovery: Discovery | None = None

    @model_validator(mode="after")
    def _discovers(self) -> Cluster:
        if self.discovery and self.nodes == "listed":
            raise ValueError("'discovery' needs 'nodes: from-cluster'; add that, or remove it")
        return self


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

    @model_validator(mode="before")
    @classmethod
    def _in_metres(cls, data: object) -> object:
        if isinstance(data, dict) and "latitude" in data:
            raise ValueError(
                "has x and y, in metres of the map frame; in detector rules, 'map' says where that "
                "frame is on earth, and only sources report degrees"
            )
        return data


class FurtherDomain(CamelModel):
    """A further access domain of a node, besides the domain whose patterns match the node."""

    name: DnsLabel
    zenoh: Zenoh | None = None
    wan: Wan | None = None


class Node(CamelModel):
    """A C-ITS entity that runs services."""

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
    # What all services on the node may request together (`demandops.decide.checks.forbidden`)
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

    @cached_property  # a copy with another id has a selector, so that its labels stay right
    def labels(self) -> Mapping[str, str]:
        return dict(self.selector) if self.selector is not None else {NODE_LABEL: self.id}

    def in_domain(self, further: FurtherDomain) -> Node:
        # `zenoh` and `wan` are not the node's own, because two programs cannot listen on one port
        return self.model_copy(
            update={
                "id": id_in_domain(self.id, further.name),
                "selector": self.labels,
                "zenoh": further.zenoh,
                "wan": further.wan,
                "bridged": {},
                "access_domains": (),
            }
        )

    def most(self, resource: str) -> int | None:  # in thousandths; None means no limit
        if self.capacity is None:
            return None
        if resource in self.capacity:
            return amount_of(self.capacity[resource])
        # every node has cpu and memory, but a resource such as a GPU only if it is listed
        return None if resource in ("cpu", "memory") else 0


def id_in_domain(node: str, domain: str) -> str:
    return f"{node}@{domain}"


class Broker(CamelModel):
    """A message broker and the node that it runs on."""

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
