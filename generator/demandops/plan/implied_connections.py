"""Connections that a demand leaves out: its inputs of other nodes must come by something.

A derived connection is claimed like one that was listed, by the demand that needs it. So it is
shared with others, follows when the demand moves its application, and goes with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from demandops.config.config import Config
from demandops.demand.demand_request import (
    ApplicationDemand,
    ConnectionDemand,
    DemandRequest,
    InputTopic,
)
from demandops.demand.route import Route
from demandops.identifiers import topic_problem
from demandops.ledger.apply import Ledger
from demandops.plan.planner import outputs
from demandops.plan.release import ServiceKey


def with_connections(request: DemandRequest, ledger: Ledger, config: Config) -> DemandRequest:
    """Return the request with a connection for each input that would not arrive otherwise.

    One that others hold and that brings the topic already is joined; else the two nodes share one
    connection of their own. None is derived from a faulty input, which is told as it is.
    """
    found = list(request.connections)
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
            if (app.node, topic.topic) in brought or not _sound(app, topic, config):
                continue
            wanted = _connection(app, topic.source, topic.topic, ledger)
            same = (wanted.id, wanted.source, wanted.target)
            known = next((c for c in found if (c.id, c.source, c.target) == same), None)
            if known is None:
                found.append(replace(wanted, for_input=f"applications[{index}].{foreign.field}"))
                continue
            topics = dict.fromkeys((*known.topics, *wanted.topics))
            found[found.index(known)] = replace(known, topics=tuple(topics))
    return replace(request, connections=tuple(found))


def _sound(app: ApplicationDemand, topic: InputTopic, config: Config) -> bool:
    return {app.node, topic.source} <= config.domain_of.keys() and not topic_problem(topic.topic)


@dataclass(frozen=True, slots=True)
class ForeignInput:
    """A topic of another node that an application needs at its own.

    ``name`` is the role, or ``<service>.<output>`` of what a service at that node makes of one;
    ``field`` is where in the application the topic behind it is listed.
    """

    name: str
    topic: InputTopic
    field: str


def foreign_inputs(app: ApplicationDemand, config: Config) -> list[ForeignInput]:
    """Return all that must be carried to the application's node."""
    appdef = config.appdefs[app.appdef]
    wanted = set()
    for service in appdef.services.values():
        if service.each is not None and service.placement == "application":
            wanted.add(service.each)
        wanted |= set(service.inputs.values())
    found = []
    for name in sorted(wanted):
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
    assert app.connect is not None  # noqa: S101 - the caller has looked
    for id in ledger.bringing(app.node, topic):
        for standing in ledger.connection(id):
            route = standing.topics.get(topic)
            ends = (standing.source, standing.target)
            if ends == (source, app.node) and route is not None and not route.reverse:
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
