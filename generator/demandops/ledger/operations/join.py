"""Joining: a request of the reference's action adds to what its demand already holds."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

from demandops.demand.claim import (
    ApplicationClaim,
    Claim,
    ClaimKey,
    ConnectionClaim,
    Subject,
    SubjectKind,
    demand_id,
)
from demandops.demand.demand_request import ApplicationDemand, ConnectionDemand, DemandRequest
from demandops.errors import Fault, Refused
from demandops.ledger.ledger import Changes, Ledger, claim_changes
from demandops.ledger.operations.claim_from_demand import application_claim, connection_claim
from demandops.ledger.operations.conflicts import application_conflicts, connection_conflicts


def join(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Book a whole request, in addition to what its demand holds.

    Raises:
        Refused: with every conflict with an existing claim.
    """
    faults: list[Fault] = []
    start = ledger
    keys: list[ClaimKey] = []
    for index, app in enumerate(request.applications):
        faults += application_conflicts(f"applications[{index}]", app, ledger)
        key = ClaimKey(
            Subject(SubjectKind.APPLICATION, app.id), demand_id(request.id, app.requesters)
        )
        current = ledger.get(key)
        claim: Claim = application_claim(
            _extended_application(app, current), request.id, key.demand, current, now
        )
        ledger = ledger.replace(key, claim)
        keys.append(key)
    for index, connection in enumerate(request.connections):
        faults += connection_conflicts(f"connections[{index}]", connection, ledger)
        key = ClaimKey(
            Subject(SubjectKind.CONNECTION, connection.id),
            demand_id(request.id, connection.requesters),
        )
        current = ledger.get(key)
        claim = connection_claim(
            _extended_connection(connection, current), request.id, key.demand, current, now
        )
        ledger = ledger.replace(key, claim)
        keys.append(key)
    if faults:
        raise Refused(faults)
    return ledger, Changes(claims=claim_changes(start, ledger, keys))


def _extended_application(app: ApplicationDemand, current: Claim | None) -> ApplicationDemand:
    """Return the application with the inputs and parameters that the demand already holds."""
    if not isinstance(current, ApplicationClaim):
        return app
    inputs = {
        role: (*current.inputs.get(role, ()), *app.inputs.get(role, ()))
        for role in {*current.inputs, *app.inputs}
    }
    return replace(app, inputs=inputs, parameters={**current.parameters, **app.parameters})


def _extended_connection(connection: ConnectionDemand, current: Claim | None) -> ConnectionDemand:
    """Return the connection with the topics and the broker that the demand already holds."""
    if not isinstance(current, ConnectionClaim):
        return connection
    return replace(
        connection,
        topics=(*current.topics.values(), *connection.topics),
        broker=connection.broker or current.broker,
    )
