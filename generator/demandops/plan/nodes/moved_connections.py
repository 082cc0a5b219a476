"""Moved connections: when an application moves, the connections of its demands follow.

The connections then carry the same topics to or from the new node, with the same type and options.
A move adds no connections if the application needed some before and its demand held none of them.
A goal of the reference's action lists its connections itself, so a move does not change these
connections.
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

Move = Callable[[Application], Application]
"""A function that returns the given application on its new nodes."""


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
        if not claim.joined:
            ledger, touched = _followed(replace(world, ledger=ledger), claim, move)
            keys += touched
    return replace(world, ledger=ledger), claim_changes(world.ledger, ledger, keys)


def _followed(world: World, claim: Claim, move: Move) -> tuple[Ledger, list[ClaimKey]]:
    """Return the ledger in which the connections of a demand follow its application.

    ``claim`` is the demand's claim on the application before the move. The second value has the
    keys of the changed claims.
    """
    config, ledger, keys = world.config, world.ledger, list[ClaimKey]()
    app = claim.application
    old, new = (flows(config, each) for each in (app, move(app)))
    before, after = ({_path(flow) for flow in each} for each in (old, new))
    gone = [flow for flow in old if _path(flow) not in after]
    needed = (*new, *_flows_of_others(world, claim))
    still = {(flow.sender, flow.receiver, flow.target) for flow in needed}
    carried: dict[tuple[str, str], Connection] = {}
    derives = not old or any(True for flow in old for _ in _carrying(ledger, claim.demand, flow))
    for flow in gone:
        for held, route in _carrying(ledger, claim.demand, flow):
            carried[flow.topic, flow.target] = replace(held.connection, topics=(route,))
            if (flow.sender, flow.receiver, flow.target) not in still:
                left = held.connection.without_topics({(route.source,)})
                ledger = ledger.replace(held.key, replace(held, held=left) if left else None)
                keys.append(held.key)
    for flow in new:
        known = carried.get((flow.topic, flow.target))
        if _path(flow) not in before and derives:
            booked = _carried_by(flow, known, claim, replace(world, ledger=ledger))
            ledger = ledger.replace(booked.key, booked)
            keys.append(booked.key)
    return ledger, keys


def _path(flow: Flow) -> tuple[str, str, str, str]:
    return flow.topic, flow.sender, flow.receiver, flow.target


def _flows_of_others(world: World, claim: Claim) -> Iterator[Flow]:
    """Yield the flows of the other applications that the demand of ``claim`` holds."""
    for other in world.ledger.claims_of_demand(claim.demand):
        if other.is_on_application and other.subject != claim.subject:
            yield from flows(world.config, other.application)


def renaming(world: World, claim: Claim) -> Iterator[tuple[Flow, Route]]:
    """Yield (flow, route) for each input whose topic is renamed by a connection of the demand.

    The flow brings the input to the application, and the route renames the topic on the way.
    """
    for flow in flows(world.config, claim.application):
        for _, route in _carrying(world.ledger, claim.demand, flow):
            if flow.delivery is None and route.read_topic != route.written_topic:
                yield flow, route


def _carrying(ledger: Ledger, demand: str, flow: Flow) -> Iterator[tuple[Claim, Route]]:
    """Yield (claim, route) for each connection of a demand that carries a flow.

    The claim is the demand's claim on the connection, and the route is the one with the flow's
    topic.
    """
    for id in ledger.connections_bringing(flow.receiver, flow.target):
        claim = ledger.get(ClaimKey(Subject(SubjectKind.CONNECTION, id), demand))
        for route in claim.connection.topics if claim else ():
            assert claim is not None  # noqa: S101 - ``route`` comes from the claim
            ends = route.sender_and_receiver(*claim.connection.nodes)
            if (*ends, route.written_topic) == (flow.sender, flow.receiver, flow.target):
                yield claim, route


def _carried_by(flow: Flow, known: Connection | None, claim: Claim, world: World) -> Claim:
    """Return a demand's new or extended claim on the connection that carries a flow from now on.

    ``known`` is the connection that carried the topic before the move, or ``None``. If no claim
    brings the topic to the receiver yet, the connection gets the type and options of ``known``.
    """
    route = known.topics[0] if known else None
    flow = replace(flow, topic=route.read_topic) if route else flow
    connection = connection_for(flow, known.known_type.word if known else "auto", world.ledger)
    if route and not world.ledger.is_carried_to(flow.receiver, flow.target):
        route = replace(route, source=flow.topic, target=flow.target, reverse=False)
        connection = replace(connection, topics=(route,))
    put = Put("", (Demanded(connection, claim.requesters, str),))
    (one,) = admission.with_chosen_types(put, world.config, world.ledger.connection).demanded
    made = replace(claim, held=one.held.booked(), partial={})
    current = world.ledger.get(made.key)
    if current is None:
        return made
    return replace(current, held=current.connection.extended(made.connection).booked())
