"""Connections that a demand leaves out: its inputs of other nodes must come by something.

A derived connection is claimed like one that was listed, by the demand that needs it. So it is
shared with others, follows when the demand moves its application, and goes with it.
"""

from __future__ import annotations

from dataclasses import replace

from generator.catalog.appdef import ApplicationDefinition
from generator.catalog.catalog import Catalog
from generator.catalog.identifiers import topic_problem
from generator.demand.request import (
    ApplicationDemand,
    ConnectionDemand,
    DemandRequest,
    InputTopic,
)
from generator.ledger.books import Ledger


def with_connections(request: DemandRequest, ledger: Ledger, catalog: Catalog) -> DemandRequest:
    """Return the request with a connection for each input that would not arrive otherwise.

    One that others hold and that brings the topic already is joined; else the two nodes share one
    connection of their own. None is derived from a faulty input, which is told as it is.
    """
    found = list(request.connections)
    brought = {(c.target, target) for c in request.connections for _, target in c.topics}
    for index, app in enumerate(request.applications):
        appdef = catalog.appdefs.get(app.appdef)
        if app.connect is None or appdef is None:
            continue
        for role, topic in foreign_inputs(app, appdef):
            if (app.node, topic.topic) in brought or not _sound(app, topic, catalog):
                continue
            wanted = _connection(app, topic.source, topic.topic, ledger)
            place = f"applications[{index}].inputs.{role}[{app.inputs[role].index(topic)}]"
            same = (wanted.id, wanted.source, wanted.target)
            known = next((c for c in found if (c.id, c.source, c.target) == same), None)
            if known is None:
                found.append(replace(wanted, because=place))
                continue
            topics = dict.fromkeys((*known.topics, *wanted.topics))
            found[found.index(known)] = replace(known, topics=tuple(topics))
    return replace(request, connections=tuple(found))


def _sound(app: ApplicationDemand, topic: InputTopic, catalog: Catalog) -> bool:
    return {app.node, topic.source} <= catalog.domain_of.keys() and not topic_problem(topic.topic)


def foreign_inputs(
    app: ApplicationDemand, appdef: ApplicationDefinition
) -> list[tuple[str, InputTopic]]:
    """Return (role, topic) of every input that must be carried to the application's node."""
    at_source = {
        service.each for service in appdef.services.values() if service.placement == "source"
    }
    return [
        (role, topic)
        for role, topics in sorted(app.inputs.items())
        if role not in at_source
        for topic in topics
        if topic.source != app.node
    ]


def _connection(
    app: ApplicationDemand, source: str, topic: str, ledger: Ledger
) -> ConnectionDemand:
    for id in ledger.bringing(app.node, topic):
        for standing in ledger.connection(id):
            if standing.source == source and standing.topics.get(topic) == topic:
                return _demand(app, id, standing.type.value, source, topic)
    own = f"derived/{source}/{app.node}"
    standing_types = [claim.type.value for claim in ledger.connection(own)]
    assert app.connect is not None  # noqa: S101 - the caller has looked
    kind = standing_types[0] if standing_types else app.connect
    return _demand(app, own, kind, source, topic)


def _demand(
    app: ApplicationDemand, id: str, kind: int, source: str, topic: str
) -> ConnectionDemand:
    return ConnectionDemand(
        id=id,
        type=kind,
        source=source,
        target=app.node,
        topics=((topic, topic),),
        broker="",
        requesters=app.requesters,
        term=app.term,
    )
