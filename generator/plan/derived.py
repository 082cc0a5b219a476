"""Connections that a demand leaves out: its inputs of other nodes must come by something.

A derived connection is claimed like one that was listed, by the demand that needs it. So it is
shared with others, follows when the demand moves its application, and goes with it.
"""

from __future__ import annotations

from dataclasses import replace

from generator.catalog.catalog import Catalog
from generator.demand.request import (
    ApplicationDemand,
    ConnectionDemand,
    DemandRequest,
    InputTopic,
)
from generator.demand.route import Route
from generator.ledger.ledger import Ledger
from generator.plan.planner import outputs
from generator.plan.release import ServiceKey


def with_connections(request: DemandRequest, ledger: Ledger, catalog: Catalog) -> DemandRequest:
    """Return the request with a connection for each input that would not arrive otherwise.

    One that others hold and that brings the topic already is joined; else the two nodes share one
    connection of their own.
    """
    found = {connection.id: connection for connection in request.connections}
    brought = {
        (route.ends(connection.source, connection.target)[1], route.written)
        for connection in request.connections
        for route in connection.topics
    }
    for app in request.applications:
        if app.connect is None or app.appdef not in catalog.appdefs:
            continue
        for _, topic in foreign_inputs(app, catalog):
            if (app.node, topic.topic) in brought:
                continue
            wanted = _connection(app, topic.source, topic.topic, ledger)
            known = found.get(wanted.id, wanted)
            topics = dict.fromkeys((*known.topics, *wanted.topics))
            found[wanted.id] = replace(known, topics=tuple(topics))
    return replace(request, connections=tuple(found.values()))


def foreign_inputs(app: ApplicationDemand, catalog: Catalog) -> list[tuple[str, InputTopic]]:
    """Return (role, topic) of all that must be carried to the application's node.

    Inputs that other nodes publish, and what services at such a node make of them.
    """
    appdef = catalog.appdefs[app.appdef]
    found: dict[tuple[str, InputTopic], None] = {}
    wanted = set()
    for service in appdef.services.values():
        if service.each is not None and service.placement == "application":
            wanted.add(service.each)
        wanted |= set(service.inputs.values())
    for origin in sorted(wanted):
        producer_name, _, output = origin.partition(".")
        producer = appdef.services[producer_name] if output else None
        if producer is not None and producer.placement != "source":
            continue
        role = str(producer.each) if producer else origin
        for topic in app.inputs.get(role, ()):
            if topic.source == app.node:
                continue
            carried = topic
            if producer is not None:
                key = ServiceKey(
                    producer_name, topic.source, source=topic.source, topic=topic.topic
                )
                carried = InputTopic(outputs(catalog, producer, key)[output], topic.source)
            found[origin, carried] = None
    return list(found)


def _connection(
    app: ApplicationDemand, source: str, topic: str, ledger: Ledger
) -> ConnectionDemand:
    assert app.connect is not None  # noqa: S101 - the caller has looked
    for id in ledger.bringing(app.node, topic):
        standing = ledger.connection(id)[0]
        route = standing.topics.get(topic)
        if (standing.source, standing.target) == (source, app.node) and route is not None:
            return _demand(app, id, standing.type.value, source, route)
    return _demand(app, f"derived/{source}/{app.node}", app.connect, source, Route(topic, topic))


def _demand(
    app: ApplicationDemand, id: str, kind: int, source: str, route: Route
) -> ConnectionDemand:
    return ConnectionDemand(
        id=id,
        type=kind,
        source=source,
        target=app.node,
        topics=(route,),
        broker="",
        requesters=app.requesters,
        term=app.term,
    )
