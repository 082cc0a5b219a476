"""Implied connections: those that a demand needs, but does not list.

The demand claims such a connection in the same way as one that it lists. So the connection is
shared with other demands, changes when the application moves, and is released with the demand.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import TypeAlias

from demandops.base.naming import Subject, SubjectKind, TopicKey, topic_problem
from demandops.connections.connection import Connection, Route
from demandops.connections.connection_types import type_named
from demandops.decide.planning.flows import Flow, flows
from demandops.model.config.config import Config
from demandops.model.demand.application import Application
from demandops.model.demand.claim import ClaimKey
from demandops.model.demand.demand_request import AnyRequest, Demanded
from demandops.model.ledger.ledger import Changes, Ledger, World, claim_changes

# The id, source and target of a connection.
_Ends: TypeAlias = "tuple[str, ...]"


def _needing_field(field: str, path: str) -> str:
    # The goal does not list an implied connection, so its faults are reported at the input,
    # delivery or node that needs it. Only its requesters are written in the goal.
    return path if path.startswith("requesters") else field


def with_implied_connections(request: AnyRequest, ledger: Ledger, config: Config) -> AnyRequest:
    """Return the request with a connection for each flow that no listed connection brings.

    If a claimed connection carries the flow, the demand claims this connection too. Otherwise the
    demand gets a derived connection between the two nodes. An application with ``connect: none``
    gets no connection.
    """
    first: dict[_Ends, Demanded] = {}
    routes: dict[_Ends, dict[tuple[str, str], Route]] = {}
    listed = [each.held for each in request.demanded if isinstance(each.held, Connection)]
    brought = {
        (route.sender_and_receiver(*connection.nodes)[1], route.written_topic)
        for connection in listed
        for route in connection.topics
    }
    for item in request.demanded:
        app = item.held
        if not isinstance(app, Application) or item.connect == "none":
            continue
        places: dict[TopicKey, str] = {
            (role, topic.topic, topic.source): f"inputs.{role}[{index}]"
            for role, topics in app.inputs.items()
            for index, topic in enumerate(topics)
        }
        for flow in flows(config, app):
            # Admission reports an unknown node and a topic that is not valid, so neither gets a
            # connection here.
            is_valid = (
                {flow.sender, flow.receiver} <= config.domain_of.keys()
                and not topic_problem(flow.topic)
                and not topic_problem(flow.target)
            )
            if (flow.receiver, flow.target) in brought or not is_valid:
                continue
            needed = connection_for(flow, item.connect, ledger)
            field = places.get(flow.root, "node")
            if flow.delivery is not None:
                field = f"deliver[{flow.delivery}]"
            place = partial(_needing_field, item.place(field))
            note = ""
            if needed.type is not None and item.connect not in ("auto", needed.type.word):
                topic = needed.topics[0].source
                note = (
                    f"already carries {topic} by {needed.type.name}, so {topic} gets no "
                    f"{item.connect.upper()} connection"
                )
            ends = (needed.id, *needed.nodes)
            first.setdefault(ends, Demanded(needed, item.requesters, place, item.term, note=note))
            topics = routes.setdefault(ends, {})
            for route in needed.topics:
                names = (route.source, route.target)
                topics[names] = route if route.type else topics.get(names, route)
    demanded = []
    for item in request.demanded:
        if isinstance(item.held, Connection):
            more = routes.pop((item.held.id, *item.held.nodes), {})
            carried = (*item.held.topics, *more.values())
            demanded.append(_with_topics(item, carried) if more else item)
        else:
            demanded.append(item)
    implied = (_with_topics(first[ends], topics.values()) for ends, topics in routes.items())
    return replace(request, demanded=(*demanded, *implied))


def _with_topics(item: Demanded, topics: Iterable[Route]) -> Demanded:
    assert isinstance(item.held, Connection)  # noqa: S101 - callers pass only connections
    return replace(item, held=replace(item.held, topics=tuple(dict.fromkeys(topics))))


def without_idle_deliveries(
    before: Ledger, after: World, changes: Changes
) -> tuple[Ledger, Changes]:
    """Return the ledger and changes, both without deliveries of outputs that are no longer made.

    ``before`` is the ledger before a node is decommissioned, ``after`` the world after it, and
    ``changes`` is what this changes.
    """
    ledger, keys = after.ledger, [change.key for change in changes.claims]
    # With the node a demand may lose an input, and with the input an output of its application. The
    # demand may still hold the connection that delivers this output from one remaining node to
    # another, where nothing would come any longer.
    for change in changes.claims:
        if change.before is None or change.key.subject.kind is not SubjectKind.APPLICATION:
            continue
        remaining = flows(after.config, change.after.application) if change.after else []
        still = {(flow.receiver, flow.target) for flow in remaining}
        for flow in flows(after.config, change.before.application):
            place = (flow.receiver, flow.target)
            for id in ledger.connections_bringing(*place) if place not in still else ():
                key = ClaimKey(Subject(SubjectKind.CONNECTION, id), change.key.demand)
                claim = ledger.get(key)
                if claim is not None and flow.delivery is not None:
                    held = claim.held.without_topics({(flow.topic,)})
                    ledger = ledger.replace(key, replace(claim, held=held) if held else None)
                    keys.append(key)
    return ledger, replace(changes, claims=claim_changes(before, ledger, keys))


def connection_for(flow: Flow, type: str, ledger: Ledger) -> Connection:
    """Return the connection that carries a flow, with the flow's topic as its only topic.

    It is the claimed connection that carries the flow already, or a derived one of ``type``. With
    ``auto``, a derived connection has no type yet.
    """
    ends, names = (flow.sender, flow.receiver), (flow.topic, flow.target)
    for id in ledger.connections_bringing(flow.receiver, flow.target):
        for claim in ledger.connection_claims(id):
            connection = claim.connection
            for route in filter(None, map(connection.route, names)):
                is_same = (route.read_topic, route.written_topic) == names
                if is_same and route.sender_and_receiver(*connection.nodes) == ends:
                    return Connection(id, connection.type, *connection.nodes, "", (route,))
    kind = None if type == "auto" else type_named(type)
    route = Route(*names, type=flow.type if kind and kind.needs_types else "")
    return Connection(f"derived/{flow.sender}/{flow.receiver}", kind, *ends, "", (route,))
