"""Connections that a demand needs for inputs from other nodes, but does not list.

The demand claims such a connection as if it had listed it. So the connection is shared with other
demands, changes when the application moves, and is released with the demand.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

from demandops.config.config import Config
from demandops.connections.connection import Connection
from demandops.connections.connection_types import type_named
from demandops.connections.route import Route
from demandops.demand.application import Application, InputTopic
from demandops.demand.demand_request import AnyRequest, Demanded
from demandops.identifiers import topic_problem
from demandops.ledger.ledger import Ledger
from demandops.plan.output_topics import outputs
from demandops.plan.release import ServiceKey


def _input_field(field: str, path: str) -> str:
    """Return the goal's field for a fault of an implied connection: the input or a requester."""
    return path if path.startswith("requesters") else field


def with_implied_connections(request: AnyRequest, ledger: Ledger, config: Config) -> AnyRequest:
    """Return the request with a connection for each input that no listed connection brings.

    A connection that already brings the topic is joined. Otherwise the two nodes get a connection
    of their own. A faulty input adds none; admission reports it.
    """
    first: dict[_Ends, Demanded] = {}
    routes: dict[_Ends, dict[Route, None]] = {}
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
        if app.appdef not in config.appdefs:
            continue
        for foreign in foreign_inputs(app, config):
            topic = foreign.topic
            if (app.node, topic.topic) in brought or not _is_valid(app, topic, config):
                continue
            needed = _connection(app, one.connect, topic, ledger)
            place = partial(_input_field, one.place(foreign.field))
            ends = (needed.id, *needed.nodes)
            first.setdefault(ends, replace(one, held=needed, place=place, connect="none"))
            routes.setdefault(ends, {}).update(dict.fromkeys(needed.topics))
    demanded = []
    for one in request.demanded:
        if isinstance(one.held, Connection):
            more = routes.pop((one.held.id, *one.held.nodes), {})
            demanded.append(_with_topics(one, (*one.held.topics, *more)) if more else one)
        else:
            demanded.append(one)
    implied = (_with_topics(first[ends], topics) for ends, topics in routes.items())
    return replace(request, demanded=(*demanded, *implied))


_Ends: TypeAlias = "tuple[str, ...]"


def _with_topics(one: Demanded, topics: Iterable[Route]) -> Demanded:
    assert isinstance(one.held, Connection)  # noqa: S101 - the caller knows
    return replace(one, held=replace(one.held, topics=tuple(dict.fromkeys(topics))))


def _is_valid(app: Application, topic: InputTopic, config: Config) -> bool:
    return {app.node, topic.source} <= config.domain_of.keys() and not topic_problem(topic.topic)


@dataclass(frozen=True, slots=True)
class ForeignInput:
    """A topic of another node that an application needs at its own.

    ``name`` is the role, or ``<service>.<output>`` if a service at the other node makes the topic.
    ``field`` is the application's field that lists the original topic.
    """

    name: str
    topic: InputTopic
    field: str


def foreign_inputs(app: Application, config: Config) -> list[ForeignInput]:
    """Return the topics that must be carried to the application's node."""
    appdef = config.appdefs[app.appdef]
    needed = set()
    for service in appdef.services.values():
        if service.each is not None and service.placement == "application":
            needed.add(service.each)
        needed |= set(service.inputs.values())
    found = []
    for name in sorted(needed):
        producer_name, _, output = name.partition(".")
        producer = appdef.services[producer_name] if output else None
        if producer is not None and producer.placement != "source":
            continue
        role = str(producer.each) if producer else name
        for index, topic in enumerate(app.inputs.get(role, ())):
            if topic.source == app.node:
                continue
            carried = topic
            if producer is not None:
                key = ServiceKey(
                    producer_name, topic.source, source=topic.source, topic=topic.topic
                )
                names = outputs(config, producer, key, further=topic.further)
                carried = InputTopic(names[output], topic.source)
            found.append(ForeignInput(name, carried, f"inputs.{role}[{index}]"))
    return found


def _connection(app: Application, type: str, topic: InputTopic, ledger: Ledger) -> Connection:
    """Return the connection that brings a topic to an application, with only this topic."""
    ends, name = (topic.source, app.node), topic.topic
    for id in ledger.connections_bringing(app.node, name):
        for claim in ledger.connection_claims(id):
            known, route = claim.connection, claim.connection.route(name)
            if known.nodes == ends and route is not None and not route.reverse:
                return Connection(id, known.type, *ends, "", (route,))
    kind = None if type == "auto" else type_named(type)
    id = f"derived/{topic.source}/{app.node}"
    return Connection(id, kind, *ends, "", (Route(name, name),))
