"""Demand requests: one class for each operation on the ledger.

Goals of ROS actions and YAML files are parsed into these values. The admission checks them, and the
booking carries them out. "The reference" is the application manager of the paper, whose action
``DeploymentRequest`` is served too. Requests that nobody sends stand where they are made: ``Wait``
in :mod:`.records`, ``Drain`` in :mod:`.booking`, ``Restoration`` in :mod:`.rollback`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

from demandops.base.errors import Fault, Refused, fault
from demandops.base.naming import Subject, id_problem
from demandops.connections.connection import Connection
from demandops.model.config.inventory import Position
from demandops.model.demand.claim import Application, Term

# Takes a field's path in an application or connection, and returns the field's path in the goal.
# For example, ``inputs.ego_data[2].source`` becomes ``applications[0].inputs.ego_data[2].source``.
Place = Callable[[str], str]


@dataclass(frozen=True, slots=True)
class Demanded:
    """One application or connection that a request lists, and its requesters."""

    held: Application | Connection
    requesters: tuple[str, ...]
    place: Place
    term: Term | None = None
    # the type of the connections that an application implies; ``auto``: any, ``none``: makes none
    connect: str = "none"
    # how a connection differs from the requested one, for a warning in the receipt
    note: str = ""
    # a sentence for each placed application or service: which node was chosen, and why
    placed: tuple[str, ...] = ()

    def fault(self, path: str, message: str, *, code: str = "invalid") -> Fault:
        return fault(self.place(path), message, code=code)


@dataclass(frozen=True, slots=True)
class DemandRequest:
    """A request; it is booked or refused as a whole."""

    id: str
    demanded: tuple[Demanded, ...] = ()
    # Empty in the reference's requests; `claim.demand_id` makes one for each item
    demand: str = ""
    # of the request as a whole: `Release` lists no items, but has requesters
    own_requesters: tuple[str, ...] = ()

    operation: ClassVar[str]  # as in commits and files
    adds_claims: ClassVar[bool] = False
    # the request is a goal of the reference's action, which names no demand
    is_reference: ClassVar[bool] = False

    def requesters(self) -> tuple[str, ...]:
        listed = (who for item in self.demanded for who in item.requesters)
        return tuple(dict.fromkeys((*self.own_requesters, *listed)))

    def subjects(self) -> tuple[Subject, ...]:
        return tuple(dict.fromkeys(item.held.subject for item in self.demanded))


AnyRequest = TypeVar("AnyRequest", bound=DemandRequest)


@dataclass(frozen=True, slots=True)
class Join(DemandRequest):
    """A goal of the reference's action, which adds to what its requesters hold already."""

    operation = "join"
    adds_claims = True
    is_reference = True


@dataclass(frozen=True, slots=True)
class Shutdown(DemandRequest):
    """A goal of the reference's action with ``shutdown``: its requesters give up what it lists."""

    operation = "shutdown"
    is_reference = True


@dataclass(frozen=True, slots=True)
class Put(DemandRequest):
    """A goal of our own action, after which the demand holds exactly what the goal lists."""

    lease_s: int | None = None
    positions: Mapping[str, Position] = field(default_factory=dict)  # of nodes that have none
    priority: int = 0  # among the demands that wait for room

    operation = "put"
    adds_claims = True


@dataclass(frozen=True, slots=True)
class Release(DemandRequest):
    operation = "release"


@dataclass(frozen=True, slots=True)
class Renew(DemandRequest):
    operation = "renew"


@dataclass(frozen=True, slots=True)
class Expire(DemandRequest):
    """The generator's request to release those claims of a demand whose lease has ended."""

    operation = "expire"


@dataclass(frozen=True, slots=True)
class Decommission(DemandRequest):
    """An operator's request to release all that needs the node, or names the requester, ``id``."""

    kinds: frozenset[str] = frozenset()  # `node`, `requester` or both
    by: str = ""  # the operator as `name <email>`
    reason: str = ""
    # one name for each access domain of the node; the admission fills them in
    nodes: tuple[str, ...] = ()

    operation = "decommission"

    # The journal stores the request as a goal. No action and no demand file can express it.
    @staticmethod
    def is_goal(data: object) -> bool:
        return isinstance(data, dict) and data.get("kind") == "Decommission"

    def goal(self) -> dict[str, Any]:
        # without `nodes`, which the admission finds again when the journal is read
        data = {"kind": "Decommission", "name": self.id, "as": sorted(self.kinds), "by": self.by}
        return data | ({"reason": self.reason} if self.reason else {})

    @classmethod
    def parse(cls, data: dict[str, Any]) -> Decommission:
        name = data.get("name")
        problem = id_problem(name) if isinstance(name, str) else "must be text"
        if problem:
            raise Refused.at("name", problem)
        kinds = frozenset(kind for kind in data.get("as", ()) if kind in ("node", "requester"))
        by, reason = (str(data.get(key) or "") for key in ("by", "reason"))
        return cls(id=str(name), kinds=kinds, by=by, reason=reason)
