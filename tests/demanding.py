"""Demands for connections with all that a route can say, which the reference's message cannot.

A demand is plain data: ``topics`` as the ledger writes them, ``type`` by name, ``auto`` included.
It goes the way that :func:`generator.decision.decide` goes with a parsed goal.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from generator.decision import State
from generator.demand import admission, carriers
from generator.demand import route as routes
from generator.demand.request import ConnectionDemand, ConnectionType, DemandRequest, Operation
from generator.errors import Refused
from generator.ledger import ledger as booking
from generator.plan.planner import affected
from generator.render import changeset
from generator.render.changeset import Changeset, Read


def request_of(demand: Mapping[str, Any]) -> DemandRequest:
    """Return a demand as a request; raises :class:`Refused` for options that no route has."""
    faults = []
    connections = []
    for place, item in enumerate(demand["connections"]):
        topics = []
        for index, (source, said) in enumerate(item.get("topics", {}).items()):
            options = {"target": said} if isinstance(said, str) else dict(said)
            target = options.pop("target", source)
            where = f"connections[{place}].topics[{index}]"
            route, found = routes.parse(where, source, target, options)
            topics.append(route)
            faults += found
        connections.append(
            ConnectionDemand(
                id=item["id"],
                type=ConnectionType[item.get("type", "auto").upper()].value,
                source=item["source"],
                target=item["target"],
                topics=tuple(topics),
                broker=item.get("broker", ""),
                requesters=tuple(item.get("requesters", ["vehicle00"])),
            )
        )
    if faults:
        raise Refused(faults)
    return DemandRequest(
        id=demand.get("id", "request"),
        operation=Operation.SHUTDOWN if demand.get("shutdown") else Operation.JOIN,
        connections=tuple(connections),
    )


def decide(
    state: State, demand: Mapping[str, Any], now: datetime, read: Read
) -> tuple[State, Changeset]:
    """Judge a demand; raises :class:`Refused`."""
    request = carriers.resolved(request_of(demand), state.catalog, state.ledger.type_of)
    faults = tuple(admission.faults(request, state.catalog))
    if faults:
        raise Refused(faults)
    ledger, changes = booking.apply(state.ledger, request, now)
    keys = affected(state.ledger, ledger, state.catalog, changes.subjects())
    world = (state.catalog, state.engine, read)
    made = changeset.of_change(state.ledger, ledger, changes.claims, keys, world)
    return State(state.catalog, state.engine, ledger), made
