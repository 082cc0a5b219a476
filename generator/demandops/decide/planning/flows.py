"""What flows where: the topics that services publish, who reads them, and what must carry them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, TypeAlias

from demandops.base import naming
from demandops.base.naming import Subject, SubjectKind, TopicKey, topic_problem
from demandops.connections.connection import Connection, Route
from demandops.connections.connection_types import type_named
from demandops.model.config.appdef import Service
from demandops.model.config.config import Config
from demandops.model.demand.demand import AnyDemand, Application, InputTopic, Item
from demandops.model.ledger.claim import ClaimKey
from demandops.model.ledger.ledger import Changes, Ledger, World, claim_changes
from demandops.model.release import ServiceKey

# ---- the topics that services publish, named as the reference names them ----
#
# ``{instance}`` in an output pattern stands for the application or the node for which a service
# runs. For a service with ``each``, ``{instance}`` stands for the source of the input. A source has
# one usual topic for an input role: the topic in the source's inventory entry or, if there is none,
# the first topic that a demand booked. Any other topic is a further topic of the source. A name
# that is made from a further topic contains the source and this topic. If the inventory names no
# usual topic, the claims record which topics are further topics. So a name stays the same while
# anybody demands the topic and nobody changes the usual topic in the inventory. The reference's
# programs subscribe to outputs by name: with other names, they would hear nothing, without an
# error.


def outputs(
    config: Config, service: Service, key: ServiceKey, *, further: bool = False
) -> dict[str, str]:
    """Return the topics by output; ``further`` is ignored if the inventory names the usual one."""
    if service.root is None:
        instance = naming.topic_part(key.application or key.node)
    else:
        topic = InputTopic(str(key.topic), str(key.source), further=further)
        text = distinguishing_text(config, service.root, topic, key.version)
        instance = naming.topic_part(topic.source, text)
    return {
        name: topic_name(pattern, instance) for name, pattern in sorted(service.outputs.items())
    }


def distinguishing_text(config: Config, role: str, topic: InputTopic, version: str) -> str:
    """Return the text that makes topic names differ although their source is the same."""
    usual = usual_topic(config, topic.source, role)
    further = topic.further if usual is None else topic.topic != usual
    return topic.distinguishing_text(further, version)


# A fusion reads hundreds of such topics, and each demand plans the fusion again.
@lru_cache(maxsize=65_536)
def published_topic(pattern: str, source: str, distinguishing: str) -> InputTopic:
    return InputTopic(topic_name(pattern, naming.topic_part(source, distinguishing)), source)


def topic_name(pattern: str, instance: str) -> str:
    return pattern.replace("{instance}", instance)


def usual_topic(config: Config, source: str, role: str) -> str | None:
    node = config.nodes.get(source)
    return node.topics.get(role) if node else None


def with_further_topics(request: AnyDemand, ledger: Ledger, config: Config) -> AnyDemand:
    """Return the request with ``further`` set for inputs that may have an instance."""
    if not request.adds_claims:
        return request
    # The claims of the put's own demand do not count, because the put may release their topics.
    own = request.demand if request.operation == "put" else None
    first: dict[tuple[str, str], str] = {}

    def is_further(role: str, topic: InputTopic) -> bool:
        usual = usual_topic(config, topic.source, role)
        if usual is None:
            booked = ledger.booked_input(role, topic.source, topic.topic)
            if booked is not None:
                return booked.further
            place = (role, topic.source)
            if place not in first and ledger.has_usual_topic(*place, except_demand=own):
                return True
            usual = first.setdefault(place, topic.topic)
        return topic.topic != usual

    apps = [item.held for item in request.demanded if isinstance(item.held, Application)]
    # A usual topic that is booked stays the usual one, even if the request lists it after others.
    for role, topic in (input for app in apps for input in _per_topic(app, config)):
        booked = ledger.booked_input(role, topic.source, topic.topic)
        if booked is not None and not booked.further:
            first.setdefault((role, topic.source), topic.topic)
    demanded = (
        replace(item, held=_marked(item.held, config, is_further))
        if isinstance(item.held, Application)
        else item
        for item in request.demanded
    )
    return replace(request, demanded=tuple(demanded))


def with_booked_topics_marked(ledger: Ledger, config: Config) -> Ledger:
    """Return the ledger with ``further`` set in claims of a format whose files do not say it."""
    first: dict[tuple[str, str], str] = {}

    def is_further(role: str, topic: InputTopic) -> bool:
        usual = usual_topic(config, topic.source, role) or topic.topic
        return first.setdefault((role, topic.source), usual) != topic.topic

    claims = [claim for claim in ledger if claim.is_on_application]
    for claim in sorted(claims, key=lambda claim: (claim.booked, claim.subject.id, claim.demand)):
        held = _marked(claim.application, config, is_further)
        ledger = ledger.replace(claim.key, replace(claim, held=held))
    return ledger


def _per_topic(app: Application, config: Config) -> Iterator[tuple[str, InputTopic]]:
    """Yield (role, topic) for each input that may have a service instance of its own."""
    for role in config.roles_with_services:
        for topic in app.inputs.get(role, ()):
            yield role, topic


def _marked(
    app: Application, config: Config, is_further: Callable[[str, InputTopic], bool]
) -> Application:
    marked: dict[str, list[InputTopic]] = {}
    for role, topic in _per_topic(app, config):
        further = is_further(role, topic)
        marked.setdefault(role, []).append(replace(topic, further=further))
    return app.with_inputs(
        {**app.inputs, **{role: tuple(topics) for role, topics in marked.items()}}
    )


# ---- flows: which topics the services of an application read, and where they come from ----
#
# The flows of a demand follow from its own applications and the configuration, never from other
# demands. So the connections that a demand needs are claimed by it and end with it.


class PublishedTopic(NamedTuple):
    """A topic of an application, and the node that publishes the topic.

    ``root`` is the key of the demanded input that ``topic`` is, or from which services make it. It
    is empty if a service makes ``topic`` from all its inputs together.
    """

    topic: InputTopic
    node: str
    root: TopicKey = ()


@dataclass(frozen=True, slots=True)
class Flow:
    """A topic that is made on one node and needed on another node.

    ``name`` is an input role of the application, or ``<service>.<output>``. ``target`` is the
    topic's name at the receiver. ``root`` is the key of the demanded topic because of which the
    flow is needed; it is empty for a delivery, and if no single topic needs the flow. ``delivery``
    is the position in ``deliver`` of the delivery that needs the flow. ``type`` is the message
    type; it is empty unless the demand names the type.
    """

    name: str
    topic: str
    sender: str
    receiver: str
    target: str
    root: TopicKey = ()
    delivery: int | None = None
    type: str = ""

    @property
    def is_output(self) -> bool:
        return "." in self.name


def node_of(app: Application, service: Service, source: str) -> str:
    """Return the service's node for inputs from ``source``; empty if there is none yet."""
    if service.nodes:
        return service.runs_at.get(app.node, "")
    if service.at_source:
        return source
    # An override moves a service without changing the chosen node, so that the service comes back
    # to this node when the override ends.
    return app.moved.get(service.name) or app.chosen_node(service.name)


def instances(app: Application, service: Service) -> Iterator[ServiceKey]:
    """Yield the keys of the instances that an application needs; a node may be empty yet."""
    if service.scope == "application":
        yield ServiceKey(service.name, node_of(app, service, ""), application=app.id)
    elif service.root is not None:
        for topic in app.inputs.get(service.root, ()):
            node = node_of(app, service, topic.source)
            version = version_of_instance(app, service)
            yield ServiceKey(service.name, node, None, topic.source, topic.topic, version)
    else:
        for node, _ in _parts(app, service):
            if node:
                yield ServiceKey(service.name, node, for_cluster=service.scope == "cluster")


def version_of_instance(app: Application, service: Service) -> str:
    """Return the ``version`` in the keys of a service's instances; empty unless separate."""
    # A shared service runs once for all versions: two drivers of one sensor do not work.
    return "" if service.shared else app.own_version


def roots_of(app: Application, service: Service, key: ServiceKey) -> list[TopicKey]:
    if service.root is not None:
        topics = app.inputs_from(service.root, str(key.source), str(key.topic))
        return [(service.root, topic.topic, topic.source) for topic in topics]
    return [
        (role, topic.topic, topic.source)
        for role in service.roots
        for topic in app.inputs.get(role, ())
        if topic.source == key.node
    ]


def topics_of_origin(config: Config, app: Application, origin: str) -> Iterator[PublishedTopic]:
    """Yield the topics that ``origin`` names: an input role, or ``<service>.<output>``."""
    name, _, output = origin.partition(".")
    if not output:
        for topic in app.inputs.get(origin, ()):
            yield PublishedTopic(topic, topic.source, (origin, topic.topic, topic.source))
        return
    producer = config.services[app.appdef][name]
    pattern = producer.outputs[output]
    if not producer.roots:
        node = node_of(app, producer, "")
        instance = naming.topic_part(app.id if producer.scope == "application" else node)
        yield PublishedTopic(InputTopic(topic_name(pattern, instance), node), node)
        return
    version = version_of_instance(app, producer)
    for role in producer.roots:
        for topic in app.inputs.get(role, ()):
            text = distinguishing_text(config, role, topic, version) if producer.root else ""
            node = topic.source if producer.at_source else node_of(app, producer, topic.source)
            yield PublishedTopic(
                published_topic(pattern, topic.source, text),
                node,
                (role, topic.topic, topic.source),
            )


def flows(config: Config, app: Application) -> list[Flow]:
    """Return the flows between nodes by ``name``; a node that is not chosen yet is empty."""
    services = config.services.get(app.appdef, {})
    # Several services of one node may read a topic, but it must come to the node only once.
    needed: dict[tuple[str, str, str, str], Flow] = {}
    for service in services.values():
        for node, part in _parts(app, service):
            for origin in service.inputs.values():
                for topic, sender, root in topics_of_origin(config, part, origin):
                    if sender != node:
                        cause = root or (next(part.topic_keys()) if service.roots else ())
                        name = topic.topic
                        flow = Flow(origin, name, sender, node, name, cause, type=topic.type)
                        needed.setdefault((name, sender, node, name), flow)
    for index, delivery in enumerate(app.deliver):
        producer, _, output = delivery.output.partition(".")
        if producer not in services or output not in services[producer].outputs:
            continue  # admission reports an unknown output
        for topic, sender, _ in topics_of_origin(config, app, delivery.output):
            name, target = topic.topic, delivery.topic or topic.topic
            if (sender, name) != (delivery.node, target):
                flow = Flow(delivery.output, name, sender, delivery.node, target, delivery=index)
                needed.setdefault((name, sender, delivery.node, target), flow)
    return sorted(needed.values(), key=lambda flow: flow.name)


def _parts(app: Application, service: Service) -> Iterator[tuple[str, Application]]:
    if service.root is not None:
        for topic in app.inputs.get(service.root, ()):
            yield node_of(app, service, topic.source), app.with_inputs({service.root: (topic,)})
    elif service.at_source:
        by_source: dict[str, dict[str, list[InputTopic]]] = {}
        for role in service.roots:
            for topic in app.inputs.get(role, ()):
                by_source.setdefault(topic.source, {}).setdefault(role, []).append(topic)
        for source, inputs in sorted(by_source.items()):
            part = {role: tuple(topics) for role, topics in inputs.items()}
            yield node_of(app, service, source), app.with_inputs(part)
    else:
        yield node_of(app, service, ""), app


# ---- implied connections: those that a demand needs, but does not list ----
#
# The demand claims such a connection in the same way as one that it lists. So the connection is
# shared with other demands, changes when the application moves, and is released with the demand.

# The id, source and target of a connection.
_Ends: TypeAlias = "tuple[str, ...]"


def with_implied_connections(request: AnyDemand, ledger: Ledger, config: Config) -> AnyDemand:
    """Return the request with a connection for each flow that no listed connection brings.

    It is the claimed connection that carries the flow, or else a derived one.
    """
    first: dict[_Ends, Item] = {}
    routes: dict[_Ends, dict[tuple[str, str], Route]] = {}
    listed = [each.held for each in request.demanded if isinstance(each.held, Connection)]
    brought = {
        (route.sender_and_receiver(*connection.nodes)[1], route.written_topic)
        for connection in listed
        for route in connection.topics
    }
    for item in request.demanded:
        app = item.held
        if not isinstance(app, Application):
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
            # what is held for its readers keeps the connections that bring its inputs now
            carrier = carrier_of(flow, ledger) if app.held_for else None
            if app.connect == "none" and carrier is None:
                continue
            needed = carrier or connection_for(flow, app.connect, ledger)
            field = item.needed_by or places.get(flow.root, "node")
            if flow.delivery is not None:
                field = f"deliver[{flow.delivery}]"
            note = ""
            if needed.type is not None and app.connect not in ("auto", needed.type.word):
                topic = needed.topics[0].source
                note = (
                    f"already carries {topic} by {needed.type.name}, so {topic} gets no "
                    f"{app.connect.upper()} connection"
                )
            ends = (needed.id, *needed.nodes)
            first.setdefault(
                ends, Item(needed, item.requesters, item.field, field, item.term, note)
            )
            topics = routes.setdefault(ends, {})
            for route in needed.topics:
                names = (route.source, route.target)
                topics[names] = route if route.type else topics.get(names, route)
    demanded = list(request.demanded)
    for index, item in enumerate(demanded):
        if isinstance(item.held, Connection):
            more = routes.pop((item.held.id, *item.held.nodes), {})
            if more:
                demanded[index] = _with_topics(item, (*item.held.topics, *more.values()))
    implied = (_with_topics(first[ends], topics.values()) for ends, topics in routes.items())
    return replace(request, demanded=(*demanded, *implied))


def _with_topics(item: Item, topics: Iterable[Route]) -> Item:
    assert isinstance(item.held, Connection)  # noqa: S101 - callers pass only connections
    return replace(item, held=replace(item.held, topics=tuple(dict.fromkeys(topics))))


def without_idle_deliveries(
    before: Ledger, after: World, changes: Changes
) -> tuple[Ledger, Changes]:
    """Return the ledger and changes, both without deliveries of outputs that are no longer made."""
    ledger, keys = after.ledger, [change.key for change in changes.claims]
    # With a decommissioned node a demand may lose an input, and with the input an output of its
    # application. The demand may still hold the connection that delivers this output from one
    # remaining node to another, where nothing would come any longer.
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


def carrier_of(flow: Flow, ledger: Ledger) -> Connection | None:
    """Return a claimed connection that brings a flow's target, from any topic of any sender."""
    for id in ledger.connections_bringing(flow.receiver, flow.target):
        for connection in (claim.connection for claim in ledger.connection_claims(id)):
            for route in connection.topics:
                _, receiver = route.sender_and_receiver(*connection.nodes)
                if (receiver, route.written_topic) == (flow.receiver, flow.target):
                    return replace(connection, broker="", topics=(route,))
    return None


def connection_for(flow: Flow, type: str, ledger: Ledger) -> Connection:
    """Return the claimed connection that carries a flow, or a derived one, only with its topic."""
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
