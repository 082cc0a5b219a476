"""Connections that a demand needs for inputs from other nodes, but does not list.

The demand claims such a connection as if it had listed it. So the connection is shared with other
demands, changes when the application moves, and is released with the demand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from demandops.config.config import Config
from demandops.connections.route import Route
from demandops.demand.demand_request import (
    ApplicationDemand,
    ConnectionDemand,
    DemandRequest,
    InputTopic,
)
from demandops.identifiers import topic_problem
from demandops.ledger.ledger import Ledger
from demandops.plan.planner import outputs
from demandops.plan.release import ServiceKey


def with_implied_connections(
    request: DemandRequest, ledger: Ledger, config: Config
) -> DemandRequest:
    """Return the request with a connection for each input that no listed connection brings.

    A connection that already brings the topic is joined. Otherwise the two nodes get a connection
    of their own. A faulty input adds none; admission reports it.
    """
    connections: dict[tuple[str, str, str], ConnectionDemand] = {}
    routes: dict[tuple[str, str, str], dict[Route, None]] = {}
    brought = {
        (route.sender_and_receiver(connection.source, connection.target)[1], route.written_topic)
        for connection in request.connections
        for route in connection.topics
    }
    for index, app in enumerate(request.applications):
        if app.connect is None or app.appdef not in config.appdefs:
            continue
        for foreign in foreign_inputs(app, config):
            topic = foreign.topic
            if (app.node, topic.topic) in brought or not _is_valid(app, topic, config):
                continue
            needed = _connection(app, topic.source, topic.topic, ledger)
            same = (needed.id, needed.source, needed.target)
            where = f"applications[{index}].{foreign.field}"
            connections.setdefault(same, replace(needed, for_input=where))
            routes.setdefault(same, {}).update(dict.fromkeys(needed.topics))
    listed = []
    for connection in request.connections:
        more = routes.pop((connection.id, connection.source, connection.target), {})
        topics = tuple(dict.fromkeys((*connection.topics, *more)))
        listed.append(replace(connection, topics=topics) if more else connection)
    implied = (replace(connections[same], topics=tuple(topics)) for same, topics in routes.items())
    return replace(request, connections=(*listed, *implied))


def _is_valid(app: ApplicationDemand, topic: InputTopic, config: Config) -> bool:
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


def foreign_inputs(app: ApplicationDemand, config: Config) -> list[ForeignInput]:
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
                carried = InputTopic(outputs(config, producer, key)[output], topic.source)
            found.append(ForeignInput(name, carried, f"inputs.{role}[{index}]"))
    return found


def _connection(
    app: ApplicationDemand, source: str, topic: str, ledger: Ledger
) -> ConnectionDemand:
    assert app.connect is not None  # noqa: S101 - the caller checks it
    own = ConnectionDemand(
        id=f"derived/{source}/{app.node}",
        type=app.connect,
        source=source,
        target=app.node,
        topics=(Route(topic, topic),),
        broker="",
        requesters=app.requesters,
        term=app.term,
    )
    for id in ledger.connections_bringing(app.node, topic):
        for claim in ledger.connection_claims(id):
            route = claim.topics.get(topic)
            ends = (claim.source, claim.target)
            if ends == (source, app.node) and route is not None and not route.reverse:
                return replace(own, id=id, type=claim.type.number, topics=(route,))
    return own
