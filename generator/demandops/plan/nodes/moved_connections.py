"""Moved connections: when an application moves, the connections of its demands follow.

The connections then carry the same topics to or from the new node, with the same type and options.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from demandops.connections.connection import Connection
from demandops.connections.route import Route
from demandops.demand import admission
from demandops.demand.application import Application
from demandops.demand.claim import Claim, ClaimKey
from demandops.demand.demand_request import Demanded, Put
from demandops.ledger.claim_changes import ClaimChange, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World
from demandops.plan.flows import Flow, flows
from demandops.plan.implied_connections import connection_for
from demandops.subject import Subject, SubjectKind

# Returns the given application on its new nodes.
Move = Callable[[Application], Application]


def with_moved(
    world: World, claims: Iterable[Claim], move: Move
) -> tuple[World, tuple[ClaimChange, ...]]:
    """Return the world with the applications of ``claims`` moved, and the changes of claims.

    The connections of the demands that hold these claims follow the applications.
    """
    ledger, keys, claims = world.ledger, list[ClaimKey](), tuple(claims)
    for claim in claims:
        ledger = ledger.replace(claim.key, replace(claim, held=move(claim.application)))
        keys.append(claim.key)
    for claim in claims:
        # A goal of the reference's action lists its connections itself, and its clients shut down
        # what they listed. So a move does not change these connections.
        if not claim.joined:
            ledger, touched = _followed(replace(world, ledger=ledger), claim, move)
            keys += touched
    return replace(world, ledger=ledger), claim_changes(world.ledger, ledger, keys)


def _followed(world: World, claim: Claim, move: Move) -> tuple[Ledger, list[ClaimKey]]:
    """Return the ledger in which the connections of a demand follow, and the changed keys.

    ``claim`` is the demand's claim on the application before the move.
    """
    config, ledger, keys = world.config, world.ledger, list[ClaimKey]()
    app = claim.application
    old, new = (flows(config, each) for each in (app, move(app)))
    before, after = ({_path(flow) for flow in each} for each in (old, new))
    needed = list(new)
    for other in ledger.claims_of_demand(claim.demand):
        if other.is_on_application and other.subject != claim.subject:
            needed += flows(config, other.application)
    still = {(flow.sender, flow.receiver, flow.target) for flow in needed}
    carried: dict[tuple[str, str], Connection] = {}
    # If the application needed connections before and its demand held none of them, the demand
    # did without, for example by ``connect: none``. Then a move adds none.
    derives = not old or any(True for flow in old for _ in _carrying(ledger, claim.demand, flow))
    for flow in old:
        if _path(flow) in after:
            continue
        for held, route in _carrying(ledger, claim.demand, flow):
            carried[flow.topic, flow.target] = replace(held.connection, topics=(route,))
            if (flow.sender, flow.receiver, flow.target) not in still:
                remaining = held.connection.without_topics({(route.source,)})
                reduced = replace(held, held=remaining) if remaining else None
                ledger = ledger.replace(held.key, reduced)
                keys.append(held.key)
    for flow in new:
        if _path(flow) not in before and derives:
            carrier = carried.get((flow.topic, flow.target))
            booked = _carried_by(flow, carrier, claim, replace(world, ledger=ledger))
            ledger = ledger.replace(booked.key, booked)
            keys.append(booked.key)
    return ledger, keys


def _path(flow: Flow) -> tuple[str, str, str, str]:
    return flow.topic, flow.sender, flow.receiver, flow.target


def renaming(world: World, claim: Claim) -> Iterator[tuple[Flow, Route]]:
    """Yield (flow, route) for each input whose topic is renamed by a connection of the demand.

    The flow brings the input to the application, and the route renames the topic on the way.
    """
    for flow in flows(world.config, claim.application):
        for _, route in _carrying(world.ledger, claim.demand, flow):
            if flow.delivery is None and route.read_topic != route.written_topic:
                yield flow, route


def _carrying(ledger: Ledger, demand: str, flow: Flow) -> Iterator[tuple[Claim, Route]]:
    """Yield (the demand's claim, route) for each connection of a demand that carries a flow."""
    for id in ledger.connections_bringing(flow.receiver, flow.target):
        claim = ledger.get(ClaimKey(Subject(SubjectKind.CONNECTION, id), demand))
        if claim is not None:
            for route in claim.connection.topics:
                ends = route.sender_and_receiver(*claim.connection.nodes)
                if (*ends, route.written_topic) == (flow.sender, flow.receiver, flow.target):
                    yield claim, route


def _carried_by(flow: Flow, carrier: Connection | None, claim: Claim, world: World) -> Claim:
    """Return a demand's new or extended claim on the connection that carries a flow from now on.

    ``carrier`` is the connection that carried the topic before the move, or ``None``. If no claim
    brings the topic to the receiver yet, the connection gets its type and options.
    """
    route = carrier.topics[0] if carrier else None
    flow = replace(flow, topic=route.read_topic) if route else flow
    connection = connection_for(flow, carrier.known_type.word if carrier else "auto", world.ledger)
    if route and not world.ledger.is_carried_to(flow.receiver, flow.target):
        route = replace(route, source=flow.topic, target=flow.target, reverse=False)
        connection = replace(connection, topics=(route,))
    put = Put("", (Demanded(connection, claim.requesters, str),))
    (item,) = admission.with_chosen_types(put, world.config, world.ledger.connection).demanded
    booked = replace(claim, held=item.held.booked(), partial={})
    current = world.ledger.get(booked.key)
    if current is None:
        return booked
    return replace(current, held=current.connection.extended(booked.connection).booked())
