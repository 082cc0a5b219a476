"""The claim that books one demanded application or connection."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime
from types import MappingProxyType
from typing import TypeVar

from demandops.connections import route as routes
from demandops.demand.claim import ApplicationClaim, Claim, ConnectionClaim
from demandops.demand.demand_request import (
    ApplicationDemand,
    ConnectionDemand,
    InputTopic,
)
from demandops.demand.lease import renewed

AnyClaim = TypeVar("AnyClaim", ApplicationClaim, ConnectionClaim)


def application_claim(
    app: ApplicationDemand, request: str, demand: str, current: Claim | None, now: datetime
) -> ApplicationClaim:
    """Return the claim that books an application.

    Args:
        app: what to book.
        request: the id of the request.
        demand: the id of the demand.
        current: the demand's claim on this application before the request.
        now: when the request was received.
    """
    claim = ApplicationClaim(
        application=app.id,
        demand=demand,
        request=request,
        requesters=tuple(sorted(set(app.requesters))),
        booked=now,
        appdef=app.appdef,
        node=app.node,
        inputs=MappingProxyType(
            {role: _merged(topics) for role, topics in sorted(app.inputs.items()) if topics}
        ),
        parameters=MappingProxyType(dict(app.parameters)),
        version=app.version,
        lease=renewed(current.lease if current else None, app.term, now),
    )
    return _with_booking_time(claim, current)


def connection_claim(
    connection: ConnectionDemand, request: str, demand: str, current: Claim | None, now: datetime
) -> ConnectionClaim:
    """Return the claim that books a connection; arguments as for :func:`application_claim`."""
    assert connection.chosen_type is not None  # noqa: S101 - admission refuses others
    claim = ConnectionClaim(
        connection=connection.id,
        demand=demand,
        request=request,
        requesters=tuple(sorted(set(connection.requesters))),
        booked=now,
        type=connection.chosen_type,
        source=connection.source,
        target=connection.target,
        broker=connection.broker,
        topics=MappingProxyType(routes.merge_routes(connection.topics)),
        lease=renewed(current.lease if current else None, connection.term, now),
    )
    return _with_booking_time(claim, current)


def _with_booking_time(claim: AnyClaim, current: Claim | None) -> AnyClaim:
    """Return a claim with the current claim's booking time if only the lease differs."""
    if current is None:
        return claim
    kept = replace(claim, booked=current.booked)
    return kept if replace(kept, lease=current.lease) == current else claim


def _merged(topics: Iterable[InputTopic]) -> tuple[InputTopic, ...]:
    """Merge topics by (topic, source); a later type fills in one that is missing."""
    types: dict[tuple[str, str], str] = {}
    for topic in topics:
        key = (topic.topic, topic.source)
        types[key] = types.get(key) or topic.type
    return tuple(InputTopic(*key, type) for key, type in sorted(types.items()))
