"""What is demanded: applications and connections, and the demand that lists them.

A demand comes as a goal of our own action ``Demand`` or of the reference's ``DeploymentRequest``,
over ROS 2 or as YAML. :func:`.goals.read_goal` turns it into a :class:`Demand`, and every fault of
form ends there. From then on the queue, the journal, the decision, proposals and waiting demands
all hold a :class:`Demand`. "The reference" is the application manager of the paper.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_left
from collections.abc import Callable, Container, Hashable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timedelta, timezone
from itertools import islice, takewhile
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    Strict,
    StrictBool,
)
from pydantic.json_schema import SkipJsonSchema

from demandops.base.errors import Fault, fault
from demandops.base.naming import Subject, SubjectKind, TopicKey, absolute_topic
from demandops.base.quoting import quoted
from demandops.connections.connection import Connection
from demandops.connections.connection_types import type_word
from demandops.model.config.base_model import PART, RECORDED, Items, Moment, time_text, without
from demandops.model.config.inventory import Position, read_condition

# ---- applications ----


@dataclass(frozen=True, slots=True, order=True)
class InputTopic:
    """An input topic of an application, and the node that publishes it.

    A demand may instead name an ``output`` of an ``application``, as ``<service>.<output>`` or
    without the service. The claim has them beside the topics that they meant (:mod:`.flows`).
    """

    __pydantic_config__: ClassVar = PART

    topic: str = ""
    source: str = ""
    type: str = ""
    # It was not the usual topic of its source when it was booked. The claim says so, because a name
    # that is made from it must not change while it is demanded (:mod:`.flows`).
    further: Annotated[StrictBool, RECORDED, SkipJsonSchema()] = False
    application: str = ""
    output: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "topic", absolute_topic(self.topic))


@dataclass(frozen=True, slots=True, order=True)
class Delivery:
    """An output of an application that is brought to a node, as ``topic`` if that is set."""

    __pydantic_config__: ClassVar = PART

    output: str = ""  # `<service>.<output>`
    node: str = ""
    topic: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "topic", absolute_topic(self.topic))


def _label_problem(text: str) -> str:
    if text.partition("=")[0] and "=" in text:
        return ""
    return f"{quoted(text)} is not a label; write it as key=value"


def _property_problem(text: str) -> str:
    if read_condition(text) is not None:
        return ""
    return f"{quoted(text)} is not a property; write name=value, name>=8 or name<=8"


@dataclass(frozen=True, slots=True)
class Requirement:
    """Requirements on a node; ``labels`` are texts like ``zone=north``.

    ``properties`` are texts like ``memoryGiB>=8``.
    """

    __pydantic_config__: ClassVar = PART

    role: str = ""
    labels: Items[Annotated[str, without(_label_problem)]] = ()
    capabilities: Items[
        Annotated[
            str, without(lambda t: "" if t else "is empty; name a capability, or leave it out")
        ]
    ] = ()
    properties: Items[Annotated[str, without(_property_problem)]] = ()

    @property
    def size(self) -> int:
        return len(self.labels) + len(self.capabilities) + len(self.properties)

    @property
    def label_pairs(self) -> list[tuple[str, str]]:
        return [(key, value) for key, _, value in (text.partition("=") for text in self.labels)]

    def united(self, other: Requirement) -> Requirement:  # two roles must be the same
        return Requirement(
            self.role or other.role,
            tuple(sorted({*self.labels, *other.labels})),
            tuple(sorted({*self.capabilities, *other.capabilities})),
            tuple(sorted({*self.properties, *other.properties})),
        )


def _with_parameters_json(schema: dict[str, Any]) -> None:
    # the schema is that of a demand, where parameters may also be JSON text (:mod:`.goals`)
    texts = {"type": "object", "additionalProperties": {"type": "string"}}
    schema["properties"]["parameters_json"] = texts


_CONNECT = type_word("auto", after=("none",))


@dataclass(frozen=True, slots=True)
class Connect:
    """The type of derived connections for an application's flows and deliveries, and their broker.

    ``auto`` derives them with any type, ``none`` derives none. Without a broker it is written as
    the word of the type.
    """

    __pydantic_config__: ClassVar = PART

    type: Annotated[str, _CONNECT] = "auto"
    broker: str = ""


def _read_connect(value: object) -> object:
    return value if isinstance(value, dict | Connect) else Connect(_CONNECT.func(value))  # type: ignore[call-arg]


@dataclass(frozen=True)
class Application:  # noqa: PLW1641 - it contains mappings, so it has no hash
    """One application: its id, type (the name of an appdef), node and inputs by role.

    ``version`` is a version or a channel of the registry. ``connect`` says how topics come to it
    that no connection of the demand carries. ``services`` maps service names to nodes.
    """

    __pydantic_config__: ClassVar = ConfigDict(**PART, json_schema_extra=_with_parameters_json)

    id: str = ""
    # ``#<number>`` if a goal of the reference's action gives the type as a number
    appdef: Annotated[str, Field(alias="type")] = ""
    node: str = ""
    inputs: Mapping[str, Items[InputTopic]] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    version: str = ""
    connect: Annotated[
        Connect,
        BeforeValidator(
            _read_connect, json_schema_input_type=_CONNECT.json_schema_input_type | Connect
        ),
        PlainSerializer(lambda c: {"type": c.type, "broker": c.broker} if c.broker else c.type),
    ] = Connect()
    deliver: Items[Delivery] = ()
    # The requirements on the node, kept to choose again; None if the demand names the node. A place
    # that requires nothing, as in each ROS message with a node, does not ask for a choice.
    place: Annotated[
        Requirement | None, AfterValidator(lambda place: None if place == Requirement() else place)
    ] = None
    # the nodes of services that have one of their own, by service
    services: Mapping[str, str] = field(default_factory=dict)
    # this version runs beside others, and the id ends in it (:mod:`.completing`)
    separate: Annotated[StrictBool, RECORDED, SkipJsonSchema()] = False
    # the nodes to which an override moves services, by service
    moved: Annotated[Mapping[str, str], RECORDED, SkipJsonSchema()] = field(default_factory=dict)
    # the services whose node the demand itself names; the generator chose the nodes of the others
    named: Annotated[Items[str], RECORDED, SkipJsonSchema()] = ()
    # The demand does not list it, but holds it for these applications: the outputs that each reads.
    held_for: Annotated[Mapping[str, Items[str]], RECORDED, SkipJsonSchema()] = field(
        default_factory=dict
    )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Application):
            return NotImplemented
        same = all(getattr(self, item.name) == getattr(other, item.name) for item in fields(self))
        # Python treats 1, 1.0 and True as equal, but a chart does not
        return same and _exact(self.parameters) == _exact(other.parameters)

    @property
    def subject(self) -> Subject:
        return Subject(SubjectKind.APPLICATION, self.id)

    @property
    def home(self) -> str:
        # its access domain sets leases and quotas
        return self.node

    @property
    def nodes(self) -> tuple[str, ...]:
        return (self.node,)

    def all_inputs(self) -> list[tuple[str, InputTopic]]:
        return [(role, topic) for role, topics in self.inputs.items() for topic in topics]

    @property
    def read_outputs(self) -> dict[str, tuple[str, ...]]:  # of other applications
        read: dict[str, set[str]] = {}
        for _, topic in self.all_inputs():
            if topic.application:
                read.setdefault(topic.application, set()).add(topic.output)
        return {id: tuple(sorted(outputs)) for id, outputs in sorted(read.items())}

    def inputs_from(self, role: str, source: str, topic: str) -> tuple[InputTopic, ...]:
        # the inputs must be sorted, as in a claim
        inputs, place = self.inputs.get(role, ()), (topic, source)
        start = bisect_left(inputs, place, key=lambda t: (t.topic, t.source))
        same = takewhile(lambda t: (t.topic, t.source) == place, islice(inputs, start, None))
        return tuple(same)

    def needs(self, node: str) -> bool:
        delivered = any(delivery.node == node for delivery in self.deliver)
        return delivered or node in self.needed_nodes()

    def needed_nodes(self) -> set[str]:
        sources = (topic.source for _, topic in self.all_inputs())
        return {*self.chosen_nodes, *self.moved.values(), *sources}

    def chosen_node(self, service: str) -> str:
        return self.services.get(service, self.node)  # an override may have moved it away

    @property
    def chosen_nodes(self) -> set[str]:
        return {self.node, *self.services.values()}

    def has_same_definition_and_nodes(self, other: Application) -> bool:
        mine, theirs = ((app.appdef, app.node, app.services, app.moved) for app in (self, other))
        return mine == theirs

    def moved_to_nodes_of(self, first: Application) -> Application:
        if (self.node, self.services, self.moved) == (first.node, first.services, first.moved):
            return self
        return replace(self, node=first.node, services=first.services, moved=first.moved)

    def booked(self) -> Application:
        # The order of a goal's lists must not reach the ledger, because the same demand in another
        # order would make a commit.
        inputs: dict[str, tuple[InputTopic, ...]] = {}
        for role, topics in sorted(self.inputs.items()):
            merged: dict[tuple[str, str], InputTopic] = {}
            for topic in topics:
                first = merged.setdefault((topic.topic, topic.source), topic)
                # only some goals give the type of a topic, and the others must not take it away
                if topic.type and not first.type:
                    merged[topic.topic, topic.source] = topic
            inputs[role] = tuple(topic for _, topic in sorted(merged.items()))
        return replace(
            self,
            deliver=tuple(sorted({*self.deliver})),
            place=self.place and self.place.united(self.place),
            named=tuple(sorted({*self.named})),
        ).with_inputs(inputs)

    def with_inputs(self, inputs: Mapping[str, tuple[InputTopic, ...]]) -> Application:
        return replace(self, inputs={role: topics for role, topics in inputs.items() if topics})

    def extended(self, more: Application) -> Application:
        roles = {*self.inputs, *more.inputs}
        inputs = {role: (*self.inputs.get(role, ()), *more.inputs.get(role, ())) for role in roles}
        parameters = {**self.parameters, **more.parameters}
        deliver = (*self.deliver, *more.deliver)
        return replace(more, inputs=inputs, parameters=parameters, deliver=deliver)

    def topic_keys(self) -> Iterator[TopicKey]:
        # (role, topic, source) of each input; without inputs one empty key
        for role, topic in self.all_inputs():
            yield role, topic.topic, topic.source
        if not any(self.inputs.values()):
            yield ()

    def without_topics(self, gone: Container[TopicKey]) -> Application | None:
        left = {
            role: tuple(t for t in topics if (role, t.topic, t.source) not in gone)
            for role, topics in self.inputs.items()
        }
        return self.with_inputs(left) if any(left.values()) else None

    def without_node(self, node: str) -> Application | None:
        if node in self.chosen_nodes or node in self.moved.values():
            return None
        deliver = tuple(delivery for delivery in self.deliver if delivery.node != node)
        left = {
            role: tuple(topic for topic in topics if topic.source != node)
            for role, topics in self.inputs.items()
        }
        return replace(self, deliver=deliver).with_inputs(left) if any(left.values()) else None

    def index_entries(self) -> Iterator[tuple[str, ...]]:
        yield ("node", self.node)
        yield ("definition", self.appdef)
        for node in (*self.services.values(), *self.moved.values()):
            yield ("node", node)
        if self.moved:
            yield ("moved",)
        for role, topic in self.all_inputs():
            yield ("takes", topic.source, topic.topic)
            if topic.application:
                yield ("reads", topic.application)
            yield ("from", topic.source)
            yield ("node", topic.source)
            if not topic.further:
                yield ("usual", topic.source, role)
        for delivery in self.deliver:
            yield ("node", delivery.node)


def _exact(values: Mapping[str, object]) -> str:
    return json.dumps(dict(values), sort_keys=True, default=repr) if values else ""


Held = Application | Connection

# ---- leases: how long a claim stays booked without a renewal ----
#
# The recorded end may lag behind the last renewal by ``slack``, so that only some renewals make a
# commit. A renewal within the slack changes nothing, and a lease ends only after the recorded end
# and the slack have passed. So no generator, not even a restarted one, releases a claim early, but
# a release may be late by the slack.

LONGEST_S = 366 * 24 * 3600

# The end of a lease that has not started. Its claim awaits approval, or a person approved it and
# the generator has not started the lease yet.
UNSTARTED = datetime(9000, 1, 1, tzinfo=timezone.utc)


def _before_unstarted(moment: datetime) -> datetime:
    if moment >= UNSTARTED:
        raise ValueError(f"{time_text(moment)} is after the year 8999; write an earlier time")
    return moment


@dataclass(frozen=True, slots=True)
class Lease:
    __pydantic_config__: ClassVar = PART

    seconds: Annotated[int, Strict(), Field(ge=1, le=LONGEST_S)]
    slack: Annotated[int, Strict(), Field(ge=0, le=LONGEST_S)] = 0
    until: Annotated[Moment, AfterValidator(_before_unstarted)] = UNSTARTED

    @property
    def has_started(self) -> bool:
        return self.until < UNSTARTED

    @property
    def expires_at(self) -> datetime:
        return self.until + timedelta(seconds=self.slack)

    def has_ended(self, now: datetime) -> bool:
        return self.expires_at < now

    def started(self, now: datetime, before: Lease | None = None) -> Lease:
        """Return the lease as it begins now, or as it renews the one that the claim had before."""
        wanted = replace(self, until=now + timedelta(seconds=self.seconds))
        if before is None:
            return wanted
        same_term = (self.seconds, self.slack) == (before.seconds, before.slack)
        # a thousand vehicles renew every few minutes, and not each renewal may make a commit
        if same_term and wanted.until <= before.expires_at:
            return before
        # the end never moves to an earlier time, because the clock may have been set back
        return replace(wanted, until=max(wanted.until, before.until))


# ---- demands ----


_ROUTE = re.compile(r"topics\[(\d+)\](.*)")


@dataclass(frozen=True, slots=True)
class Item:
    """One application or connection of a demand, and the requesters for whom it is demanded."""

    held: Held
    requesters: tuple[str, ...]
    # where the demand lists it, as in ``applications[0]``
    field: str = ""
    # For each route of a connection, the field of the demand because of which it is on this
    # connection. Of one that the demand does not list, all faults are reported there.
    places: tuple[str, ...] = ()
    is_listed: bool = True
    lease: Lease | None = None  # which has not started
    # a sentence for each placed application or service: which node was chosen, and why
    placed: tuple[str, ...] = ()

    def fault(self, path: str, message: str, *, code: str = "invalid") -> Fault:
        place = ".".join(filter(None, (self.field, path)))
        route = _ROUTE.fullmatch(path)
        if self.places and route:
            place = self.places[int(route[1])]
            place += route[2] if place.endswith("]") and ".topics[" in place else ""
        elif self.places and not self.is_listed and not path.startswith("requesters"):
            place = self.places[0]
        return fault(place, message, code=code)


Operation = Literal[
    "put",  # our own action: the demand holds exactly what the goal lists
    "release",
    "renew",
    "join",  # the reference's action: the goal adds to what its requesters hold already
    "shutdown",  # its requesters give up what the goal lists
    "expire",  # the generator's own: release those claims whose lease has ended
    "decommission",
    "rollback",
    "drain",
    "wait",
]


@dataclass(frozen=True, slots=True)
class Demand:
    """A demand, which is booked or refused as a whole."""

    operation: Operation
    id: str = ""  # of the request
    demanded: tuple[Item, ...] = ()
    # Empty for the reference's action; `claim.demand_id` makes one for each item
    demand: str = ""
    # of the demand as a whole: a release lists no items, but has requesters
    own_requesters: tuple[str, ...] = ()
    lease_s: int | None = None
    positions: Mapping[str, Position] = field(default_factory=dict)  # of nodes that have none
    priority: int = 0  # among the demands that wait for room
    # Whether it has all that a demand may leave open, and is admitted. The generator's own are.
    is_complete: bool = False
    # its leases start when a person approves it, not when it is received
    awaits_approval: bool = False
    # how what is booked differs from what was demanded, for warnings in the receipt
    notes: tuple[str, ...] = ()
    # the goal as plain data, which the journal keeps
    goal: Any = field(default=None, compare=False, repr=False)

    @property
    def adds_claims(self) -> bool:
        return self.operation in ("put", "join")

    @property
    def is_reference(self) -> bool:
        # a goal of the reference's action, which names no demand
        return self.operation in ("join", "shutdown")

    @property
    def is_release(self) -> bool:  # by the party that demanded
        return self.operation in ("release", "shutdown")

    @property
    def applications(self) -> tuple[Application, ...]:
        helds = (item.held for item in self.demanded)
        return tuple(held for held in helds if isinstance(held, Application))

    def with_each(self: AnyDemand, change: Callable[[Application], Application]) -> AnyDemand:
        demanded = (
            replace(item, held=change(item.held)) if isinstance(item.held, Application) else item
            for item in self.demanded
        )
        return replace(self, demanded=tuple(demanded))

    def requesters(self) -> tuple[str, ...]:
        listed = (who for item in self.demanded for who in item.requesters)
        return tuple(dict.fromkeys((*self.own_requesters, *listed)))

    def subjects(self) -> tuple[Subject, ...]:
        return tuple(dict.fromkeys(item.held.subject for item in self.demanded))

    def listed_subjects(self) -> set[Subject]:
        """Return the subjects that the goal lists, whatever connections carry their topics."""
        listed = {app.subject for app in self.applications}
        for item in self.demanded:
            for route in item.held.topics if isinstance(item.held, Connection) else ():
                if not route.implied:
                    id = route.listed or item.held.id
                    listed.add(Subject(SubjectKind.CONNECTION, id))
        return listed

    def touches(self) -> frozenset[Hashable] | None:
        """Return what keeps demands that share it in their order; None touches everything."""
        if self.operation in ("decommission", "rollback"):
            return None
        ids = (id for app in self.applications for id in app.read_outputs)
        read = (Subject(SubjectKind.APPLICATION, id) for id in ids)
        own = [("demand", self.demand)] if self.demand else []
        return frozenset((*self.subjects(), *read, *own))


AnyDemand = TypeVar("AnyDemand", bound=Demand)


@dataclass(frozen=True, slots=True)
class Decommission(Demand):
    """A person's request to release all that needs the node ``id``, names the requester ``id``, is
    held by the demand ``id``, or is claimed on the application ``id``.
    """

    operation: Operation = "decommission"
    kinds: frozenset[str] = frozenset()  # some of `DECOMMISSIONED`
    by: str = ""  # the operator as `name <email>`
    reason: str = ""
    # one name for each access domain of the node; the decision fills them in
    nodes: tuple[str, ...] = ()

    @property
    def verb(self) -> str:
        # a demand or an application is released; a node or a requester leaves for good
        return "decommission" if {"node", "requester"} & self.kinds else "release"


DECOMMISSIONED = ("node", "requester", "demand", "application")


@dataclass(frozen=True, slots=True)
class Rollback(Demand):
    """A person's request to book again the claims of the commit ``to``.

    It is carried out on the newest tip, so it works while others write. What they book until then
    counts as newer than the commit. With ``demand``, only its claims change. With ``application``,
    only the claims on it, and the connections of the demands that hold or held it.
    """

    operation: Operation = "rollback"
    to: str = ""
    drop_newer: bool = False  # without it, newer claims make the rollback fail
    application: str = ""
    reason: str = ""
    by: str = ""
    email: str = ""
