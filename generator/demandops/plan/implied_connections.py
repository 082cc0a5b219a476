"""Implied connections: those that a demand needs, but does not list.

A service that reads a topic of another node needs a connection. The demand claims this connection
in the same way as a connection that it lists. So the connection is shared with other demands,
changes when the application moves, and is released with the demand.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import TypeAlias

from demandops.config.config import Config
from demandops.connections.connection import Connection
from demandops.connections.connection_types import type_named
from demandops.connections.route import Route
from demandops.demand.application import Application
from demandops.demand.claim import ClaimKey
from demandops.demand.demand_request import AnyRequest, Demanded
from demandops.identifiers import topic_problem
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World
from demandops.plan.flows import Flow, flows
from demandops.subject import Subject, SubjectKind, TopicKey


def _input_field(field: str, path: str) -> str:
    """Return where in the goal to report a fault at ``path`` of an implied connection.

    A fault of a requester is reported at ``path``. Any other fault is reported at ``field``: the
    input, delivery or node that needs the connection.
    """
    return path if path.startswith("requesters") else field


def with_implied_connections(request: AnyRequest, ledger: Ledger, config: Config) -> AnyRequest:
    """Return the request with a connection for each flow that no listed connection brings.

    If a claimed connection carries the flow, the demand claims this connection too. Otherwise the
    demand gets a derived connection between the two nodes. An application with ``connect: none``
    gets no connection. An invalid input adds no connection, because admission reports the input.
    """
    first: dict[_Ends, Demanded] = {}
    routes: dict[_Ends, dict[tuple[str, str], Route]] = {}
    listed = [one.held for one in request.demanded if isinstance(one.held, Connection)]
    brought = {
        (route.sender_and_receiver(*connection.nodes)[1], route.written_topic)
        for connection in listed
        for route in connection.topics
    }
    for one in request.demanded:
        app = one.held
        if not isinstance(app, Application) or one.connect == "none":
            continue
        places: dict[TopicKey, str] = {
            (role, topic.topic, topic.source): f"inputs.{role}[{index}]"
            for role, topics in app.inputs.items()
            for index, topic in enumerate(topics)
        }
        for flow in flows(config, app):
            if (flow.receiver, flow.target) in brought or not _is_valid(flow, config):
                continue
            needed = connection_for(flow, one.connect, ledger)
            field = places.get(flow.root, "node")
            if flow.delivery is not None:
                field = f"deliver[{flow.delivery}]"
            place = partial(_input_field, one.place(field))
            ends = (needed.id, *needed.nodes)
            note = _note(needed, one.connect)
            first.setdefault(ends, Demanded(needed, one.requesters, place, one.term, note=note))
            known = routes.setdefault(ends, {})
            for route in needed.topics:
                names = (route.source, route.target)
                known[names] = route if route.type else known.get(names, route)
    demanded = []
    for one in request.demanded:
        if isinstance(one.held, Connection):
            more = routes.pop((one.held.id, *one.held.nodes), {})
            topics = (*one.held.topics, *more.values())
            demanded.append(_with_topics(one, topics) if more else one)
        else:
            demanded.append(one)
    implied = (_with_topics(first[ends], topics.values()) for ends, topics in routes.items())
    return replace(request, demanded=(*demanded, *implied))


def _note(needed: Connection, type: str) -> str:
    """Return a note if a claimed connection of another type than ``type`` carries the topic.

    Return an empty text if there is nothing to note.
    """
    if needed.type is None or type in ("auto", needed.type.word):
        return ""
    topic = needed.topics[0].source
    return (
        f"already carries {topic} by {needed.type.name}, so {topic} gets no {type.upper()} "
        "connection"
    )


_Ends: TypeAlias = "tuple[str, ...]"


def _with_topics(one: Demanded, topics: Iterable[Route]) -> Demanded:
    assert isinstance(one.held, Connection)  # noqa: S101 - callers pass only connections
    return replace(one, held=replace(one.held, topics=tuple(dict.fromkeys(topics))))


def without_idle_deliveries(
    before: Ledger, after: World, changes: Changes
) -> tuple[Ledger, Changes]:
    """Return the ledger and changes, both without deliveries of outputs that are no longer made.

    If a node is decommissioned, a demand may lose an input, and with the input an output of its
    application. The demand may still hold the connection that delivers this output from one
    remaining node to another. This function removes the output's topic from the demand's claim on
    the connection.

    Args:
        before: the ledger before the node is decommissioned.
        after: the world after the node is decommissioned.
        changes: what the decommissioning changes.
    """
    ledger, keys = after.ledger, [change.key for change in changes.claims]
    for change in changes.claims:
        if change.before is None or change.key.subject.kind is not SubjectKind.APPLICATION:
            continue
        wanted = flows(after.config, change.after.application) if change.after else []
        still = {(flow.receiver, flow.target) for flow in wanted}
        for flow in flows(after.config, change.before.application):
            place = (flow.receiver, flow.target)
            for id in ledger.connections_bringing(*place) if place not in still else ():
                key = ClaimKey(Subject(SubjectKind.CONNECTION, id), change.key.demand)
                claim = ledger.get(key)
                if claim is not None and flow.delivery is not None:
                    left = claim.held.without_topics({(flow.topic,)})
                    ledger = ledger.replace(key, replace(claim, held=left) if left else None)
                    keys.append(key)
    return ledger, replace(changes, claims=claim_changes(before, ledger, keys))


def _is_valid(flow: Flow, config: Config) -> bool:
    known = {flow.sender, flow.receiver} <= config.domain_of.keys()
    return known and not topic_problem(flow.topic) and not topic_problem(flow.target)


def connection_for(flow: Flow, type: str, ledger: Ledger) -> Connection:
    """Return the connection that carries a flow, with the flow's topic as its only topic.

    If a claimed connection already carries the flow, the result is that connection. Otherwise the
    result is a derived connection of ``type``. If ``type`` is ``auto``, this connection has no type
    yet.
    """
    ends, names = (flow.sender, flow.receiver), (flow.topic, flow.target)
    for id in ledger.connections_bringing(flow.receiver, flow.target):
        for claim in ledger.connection_claims(id):
            known = claim.connection
            for route in filter(None, map(known.route, names)):
                same = (route.read_topic, route.written_topic) == names
                if same and route.sender_and_receiver(*known.nodes) == ends:
                    return Connection(id, known.type, *known.nodes, "", (route,))
    kind = None if type == "auto" else type_named(type)
    route = Route(*names, type=flow.type if kind and kind.needs_types else "")
    return Connection(f"derived/{flow.sender}/{flow.receiver}", kind, *ends, "", (route,))
