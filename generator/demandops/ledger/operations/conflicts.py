"""Why a demand contradicts existing claims on the same application or connection."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from demandops.demand import route as routes
from demandops.demand.claim import ApplicationClaim, ConnectionClaim
from demandops.demand.demand_request import ApplicationDemand, ConnectionDemand, ConnectionType
from demandops.demand.route import Route
from demandops.errors import Fault, fault


def application_conflicts(
    where: str, app: ApplicationDemand, standing: Iterable[ApplicationClaim]
) -> Iterator[Fault]:
    """Yield what of a demanded application contradicts claims that stand on it."""
    for claim in standing:
        held = f"'{app.id}' is held by {', '.join(claim.requesters)}"
        if claim.node != app.node:
            yield fault(
                f"{where}.node",
                f"'{app.node}' contradicts what stands: {held} on '{claim.node}'; ask for that "
                "node, or wait until it is released",
                code="conflict",
            )
            return
        if claim.appdef != app.appdef:
            yield fault(
                f"{where}.appdef",
                f"'{app.appdef}' contradicts what stands: {held} as '{claim.appdef}'; use another "
                "application id",
                code="conflict",
            )
            return
        if claim.version != app.version:
            yield fault(
                f"{where}.version",
                f"'{app.version}' contradicts what stands: {held} in version '{claim.version}'; "
                "ask for the same, or use another application id",
                code="conflict",
            )
            return


def connection_conflicts(
    where: str, asked: ConnectionDemand, standing: Iterable[ConnectionClaim]
) -> Iterator[Fault]:
    """Yield what of a demanded connection contradicts claims that stand on it."""
    for claim in standing:
        held = f"'{asked.id}' is held by {', '.join(claim.requesters)}"
        for name, wanted, stands in (
            ("type", ConnectionType(asked.type).name, claim.type.name),
            ("source", asked.source, claim.source),
            ("target", asked.target, claim.target),
            ("broker", asked.broker, claim.broker),
        ):
            if wanted == stands or (name == "broker" and not (wanted and stands)):
                continue
            yield fault(
                f"{where}.{name}",
                f"'{wanted}' contradicts what stands: {held} with {name} '{stands}'; use the same, "
                "or another connection id",
                code="conflict",
            )
            return
        for index, route in enumerate(asked.topics):
            yield from _route_conflicts(f"{where}.topics[{index}]", route, claim, held)


def _route_conflicts(
    where: str, asked: Route, claim: ConnectionClaim, held: str
) -> Iterator[Fault]:
    stands = claim.topics.get(asked.source)
    if stands is None:
        for route in claim.topics.values() if asked.reverse else ():
            if route.reverse and route.target == asked.target:
                yield fault(
                    f"{where}.target",
                    f"'{asked.target}' is carried back to '{route.source}' already: {held}; one "
                    "topic goes to one place, use a second connection",
                    code="conflict",
                )
        return
    if stands.target != asked.target:
        yield fault(
            f"{where}.target",
            f"'{asked.source}' goes to '{stands.target}' already: {held}; one source topic has "
            "one target, use a second connection",
            code="conflict",
        )
    for name, value, wanted in routes.differences(stands, asked):
        yield fault(
            f"{where}.{name}",
            f"{name} {wanted} of '{asked.source}' contradicts what stands: {held} with {name} "
            f"{value}; use the same, or a second connection",
            code="conflict",
        )
