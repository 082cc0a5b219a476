"""Demand requests: one class for each operation on the ledger.

Goals of ROS actions and YAML files are parsed into these values. :func:`faults` yields all faults
of their contents. How each is carried out: :mod:`demandops.ledger.apply`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import ClassVar, TypeVar

from demandops.connections import route as routes
from demandops.connections.connection import Connection
from demandops.demand.application import Application, InputTopic
from demandops.demand.claim import OVERRIDE_PREFIX
from demandops.demand.lease import LONGEST_S, Term
from demandops.errors import Fault, fault, quoted
from demandops.identifiers import id_problem, topic_problem
from demandops.subject import Subject

Place = Callable[[str], str]
"""Maps a field of an application or connection (``inputs.ego_data[2].source``) to the goal's."""


def place_in(field: str) -> Place:
    """Return the place of an item whose fields have the same names in the goal's ``field``."""
    return lambda path: f"{field}.{path}"


@dataclass(frozen=True, slots=True)
class Demanded:
    """One application or connection that a request lists, and its requesters."""

    held: Application | Connection
    requesters: tuple[str, ...]
    place: Place
    term: Term | None = None
    connect: str = "none"
    """How to carry an application's inputs from other nodes: a type's word, ``auto``, ``none``."""

    def fault(self, path: str, message: str, *, code: str = "invalid") -> Fault:
        """Return a fault of a field of this item."""
        return fault(self.place(path), message, code=code)


@dataclass(frozen=True, slots=True)
class DemandRequest:
    """A request; it is booked or refused as a whole.

    ``demand`` is the demand's id. The reference's requests carry none; there
    :func:`demandops.demand.claim.demand_id` makes one for each subject. ``own_requesters`` are the
    requesters of the request itself, also when it lists no subject.
    """

    id: str
    demanded: tuple[Demanded, ...] = ()
    demand: str = ""
    own_requesters: tuple[str, ...] = ()

    operation: ClassVar[str]
    """Its name in commits and files."""
    adds_claims: ClassVar[bool] = False
    """Whether it can add claims."""
    is_reference: ClassVar[bool] = False
    """Whether it is a goal of the reference's action, which names no demand."""

    def requesters(self) -> tuple[str, ...]:
        """Return all requesters, each once, in the order of the request."""
        listed = (who for one in self.demanded for who in one.requesters)
        return tuple(dict.fromkeys((*self.own_requesters, *listed)))

    def subjects(self) -> tuple[Subject, ...]:
        """Return the subjects of the listed applications and connections, each once."""
        return tuple(dict.fromkeys(one.held.subject for one in self.demanded))


AnyRequest = TypeVar("AnyRequest", bound=DemandRequest)


@dataclass(frozen=True, slots=True)
class Join(DemandRequest):
    """The reference's goal: adds to what its requesters hold."""

    operation = "join"
    adds_claims = True
    is_reference = True


@dataclass(frozen=True, slots=True)
class Shutdown(DemandRequest):
    """The reference's goal with ``shutdown``: removes from what its requesters hold."""

    operation = "shutdown"
    is_reference = True


@dataclass(frozen=True, slots=True)
class Put(DemandRequest):
    """Our own goal: sets what its demand holds. ``lease_s`` is the wanted lease in seconds."""

    lease_s: int | None = None

    operation = "put"
    adds_claims = True


@dataclass(frozen=True, slots=True)
class Release(DemandRequest):
    """Releases everything that its demand holds."""

    operation = "release"


@dataclass(frozen=True, slots=True)
class Renew(DemandRequest):
    """Renews the leases of its demand."""

    operation = "renew"


@dataclass(frozen=True, slots=True)
class Expire(DemandRequest):
    """The generator releases a demand whose lease has ended."""

    operation = "expire"


@dataclass(frozen=True, slots=True)
class Decommission(DemandRequest):
    """An operator removes a node or a requester, named by ``id``, for good.

    ``kinds`` are ``node``, ``requester`` or both. ``by`` is the operator.
    """

    kinds: frozenset[str] = frozenset()
    by: str = ""

    operation = "decommission"


def faults(request: DemandRequest) -> Iterator[Fault]:
    """Yield the faults of a request that show without configuration and ledger."""
    if request.id and request.id != request.demand:  # without an id, it is the demand's
        yield from _id("id" if request.is_reference else "request", request.id)
    if not request.is_reference:
        yield from _own_fields(request)
    if not request.demanded and not isinstance(request, Release | Renew):
        yield fault(
            "id" if request.is_reference else "applications",
            "the request lists no application and no connection; list at least one",
            code="empty",
        )
    for one in request.demanded:
        yield from _id(one.place("id"), one.held.id)
        yield from _requesters(one.place("requesters"), one.requesters)
        if isinstance(one.held, Application):
            yield from _application(one.place, one.held, request.adds_claims)
        else:
            yield from _connection(one.place, one.held, request.adds_claims)


def _own_fields(request: DemandRequest) -> Iterator[Fault]:
    """Yield the faults of the fields that only our own requests have."""
    yield from _id("demand", request.demand)
    if request.demand.startswith(OVERRIDE_PREFIX):
        yield fault(
            "demand",
            f"starts with '{OVERRIDE_PREFIX}', which only overrides may use; choose "
            "another demand id",
        )
    if not request.demanded:  # else each of them is checked
        yield from _requesters("requesters", request.own_requesters)
    lease_s = request.lease_s if isinstance(request, Put) else None
    if lease_s is not None and not 0 < lease_s <= LONGEST_S:
        yield fault("lease", f"must be between 1 second and {LONGEST_S} seconds (a year)")


def _application(place: Place, app: Application, claiming: bool) -> Iterator[Fault]:
    if claiming or app.node:
        yield from _id(place("node"), app.node)
    for role, topics in app.inputs.items():
        for position, topic in enumerate(topics):
            yield from _input(place, f"inputs.{role}[{position}]", topic, claiming)


def _input(place: Place, path: str, topic: InputTopic, claiming: bool) -> Iterator[Fault]:
    problem = topic_problem(topic.topic)
    if problem:
        yield fault(place(f"{path}.topic"), problem)
    if claiming or topic.source:
        yield from _id(place(f"{path}.source"), topic.source)
    if topic.type:
        yield from _id(place(f"{path}.type"), topic.type)


def _connection(place: Place, connection: Connection, claiming: bool) -> Iterator[Fault]:
    for end, node in (("source", connection.source), ("target", connection.target)):
        if claiming or node:
            yield from _id(place(end), node)
    if connection.broker:
        yield from _id(place("broker"), connection.broker)
    if claiming and not connection.topics:
        yield fault(place("topics"), "is empty; a connection carries at least one topic, list it")
    for found in routes.faults("topics", connection.topics):
        yield fault(place(found.field), found.message, code=found.code)
    same_place = connection.source and connection.source == connection.target
    for index, route in enumerate(connection.topics):
        if claiming and same_place and route.source == route.target:
            yield fault(
                place(f"topics[{index}].target"),
                f"{quoted(route.target)} would feed itself, because source and target are both "
                f"{quoted(connection.source)}; name another target node or topic",
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
