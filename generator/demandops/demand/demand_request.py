"""Demand requests: one request for applications and connections, or to release them.

Goals of ROS actions and YAML files are parsed into the same value. :func:`faults` yields all faults
of its contents.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType

from demandops.connections import route as routes
from demandops.connections.connection_type import ConnectionType
from demandops.connections.connection_types import type_numbered
from demandops.connections.route import Route
from demandops.demand.lease import LONGEST_S, Term
from demandops.errors import Fault, fault
from demandops.identifiers import id_problem, topic_problem

OVERRIDE_PREFIX = "override:"
"""The prefix of the demand ids of claims that overrides make; no other demand may use it."""

AUTO = -1
"""The number of a connection type that a request leaves open; ``DeploymentRequest`` has none."""


class Operation(Enum):
    """What a request does to the ledger.

    The reference's goal joins or shuts down: it adds to its requesters' claims or removes from
    them. Our own goal names its demand and puts (replaces), releases or renews it. The generator
    makes ``EXPIRE`` when a lease ends. An operator makes ``DECOMMISSION`` to remove a node or a
    requester, and ``ROLLBACK`` to restore the ledger of an earlier commit.
    """

    JOIN = "join"
    SHUTDOWN = "shutdown"
    PUT = "put"
    RELEASE = "release"
    RENEW = "renew"
    EXPIRE = "expire"
    DECOMMISSION = "decommission"
    ROLLBACK = "rollback"

    @property
    def adds_claims(self) -> bool:
        """Whether the operation can add claims."""
        return self in (Operation.JOIN, Operation.PUT)

    @property
    def is_reference(self) -> bool:
        """Whether it is an operation of the reference's action, which names no demand."""
        return self in (Operation.JOIN, Operation.SHUTDOWN)


@dataclass(frozen=True, slots=True, order=True)
class InputTopic:
    """An input topic of an application, and the node that publishes it."""

    topic: str
    source: str
    type: str = ""


@dataclass(frozen=True, slots=True)
class ApplicationDemand:
    """One application of a request; ``appdef`` is ``#<number>`` if the goal's number is unknown."""

    id: str
    appdef: str
    node: str
    requesters: tuple[str, ...]
    inputs: Mapping[str, tuple[InputTopic, ...]]
    parameters: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    version: str = ""
    connect: int | None = None
    """The type of the connections to add for inputs from other nodes, if any."""
    term: Term | None = None


@dataclass(frozen=True, slots=True)
class ConnectionDemand:
    """One connection of a request.

    ``type`` is the number of a connection type, ``AUTO`` or an unknown number of the goal.
    ``broker`` is empty if the program chooses it. ``for_input`` is the field of the input for which
    the program added the connection.
    """

    id: str
    type: int
    source: str
    target: str
    topics: tuple[Route, ...]
    broker: str
    requesters: tuple[str, ...]
    term: Term | None = None
    for_input: str = ""

    @property
    def chosen_type(self) -> ConnectionType | None:
        """Its type, or ``None`` if it is open or unknown."""
        return type_numbered(self.type)


@dataclass(frozen=True, slots=True)
class DecommissionTarget:
    """The name to decommission, its kinds (``node``, ``requester``), and the operator."""

    name: str
    kinds: frozenset[str]
    by: str = ""


@dataclass(frozen=True, slots=True)
class DemandRequest:
    """A whole request, which is booked or refused as a whole.

    ``demand`` is the demand's id. The reference's requests carry none; there
    :func:`demandops.demand.claim.demand_id` makes one for each subject. ``own_requesters`` are the
    requesters of the request itself, also when it lists no subject. ``lease_s`` is the requested
    lease in seconds.
    """

    id: str
    operation: Operation
    applications: tuple[ApplicationDemand, ...] = ()
    connections: tuple[ConnectionDemand, ...] = ()
    demand: str = ""
    own_requesters: tuple[str, ...] = ()
    lease_s: int | None = None
    decommission_target: DecommissionTarget | None = None

    def requesters(self) -> tuple[str, ...]:
        """Return all requesters, each once, in the order of the request."""
        subjects: tuple[ApplicationDemand | ConnectionDemand, ...]
        subjects = (*self.applications, *self.connections)
        listed = (who for subject in subjects for who in subject.requesters)
        return tuple(dict.fromkeys((*self.own_requesters, *listed)))


def faults(request: DemandRequest) -> Iterator[Fault]:
    """Yield every fault of a request that needs neither configuration nor ledger."""
    claiming = request.operation.adds_claims
    if request.id and request.id != request.demand:  # without an id, it is the demand's
        yield from _id("id", request.id)
    yield from _own_fields(request)
    needs_subjects = request.operation not in (Operation.RELEASE, Operation.RENEW)
    if needs_subjects and not (request.applications or request.connections):
        yield fault(
            "id" if request.operation.is_reference else "applications",
            "the request lists no application and no connection; list at least one",
            code="empty",
        )
    for index, app in enumerate(request.applications):
        where = f"applications[{index}]"
        yield from _id(f"{where}.id", app.id)
        yield from _requesters(f"{where}.requesters", app.requesters)
        if claiming or app.node:
            yield from _id(f"{where}.node", app.node)
        for role, topics in app.inputs.items():
            for position, topic in enumerate(topics):
                yield from _input(f"{where}.inputs.{role}[{position}]", topic, claiming)
    for index, connection in enumerate(request.connections):
        yield from _connection(f"connections[{index}]", connection, claiming)


def _own_fields(request: DemandRequest) -> Iterator[Fault]:
    """Yield the faults of the fields that only our own requests have."""
    if request.operation.is_reference:
        return
    yield from _id("demand", request.demand)
    if request.demand.startswith(OVERRIDE_PREFIX):
        yield fault(
            "demand",
            f"starts with '{OVERRIDE_PREFIX}', which only overrides may use; choose "
            "another demand id",
        )
    if not (request.applications or request.connections):  # else each of them is checked
        yield from _requesters("requesters", request.own_requesters)
    if request.lease_s is not None and not 0 < request.lease_s <= LONGEST_S:
        yield fault("lease", f"must be between 1 second and {LONGEST_S} seconds (a year)")
    if request.operation is not Operation.PUT and request.lease_s is not None:
        yield fault("lease", "is set by a put; leave it out, or put the demand again")
    if request.operation is not Operation.PUT and (request.applications or request.connections):
        yield fault(
            "applications" if request.applications else "connections",
            f"a {request.operation.value} names only its demand; to release a part, put the "
            "demand without it",
        )


def _input(where: str, topic: InputTopic, claiming: bool) -> Iterator[Fault]:
    problem = topic_problem(topic.topic)
    if problem:
        yield fault(f"{where}.topic", problem)
    if claiming or topic.source:
        yield from _id(f"{where}.source", topic.source)
    if topic.type:
        yield from _id(f"{where}.type", topic.type)


def _connection(where: str, connection: ConnectionDemand, claiming: bool) -> Iterator[Fault]:
    yield from _id(f"{where}.id", connection.id)
    yield from _requesters(f"{where}.requesters", connection.requesters)
    for end in ("source", "target"):
        node = getattr(connection, end)
        if claiming or node:
            yield from _id(f"{where}.{end}", node)
    if connection.broker:
        yield from _id(f"{where}.broker", connection.broker)
    if claiming and not connection.topics:
        yield fault(f"{where}.topics", "is empty; a connection carries at least one topic, list it")
    yield from routes.faults(f"{where}.topics", connection.topics)
    for index, route in enumerate(connection.topics):
        same_place = connection.source and connection.source == connection.target
        if claiming and same_place and route.source == route.target:
            yield fault(
                f"{where}.topics[{index}].target",
                f"'{route.target}' would feed itself, because source and target are both "
                f"'{connection.source}'; name another target node or topic",
            )


def _id(where: str, value: str) -> Iterator[Fault]:
    problem = id_problem(value)
    if problem:
        yield fault(where, problem)


def _requesters(where: str, requesters: Iterable[str]) -> Iterator[Fault]:
    empty = True
    for index, requester in enumerate(requesters):
        empty = False
        yield from _id(f"{where}[{index}]", requester)
    if empty:
        yield fault(where, "is empty; list at least one requester")
