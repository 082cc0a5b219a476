"""What flows where: the topics that services publish, who reads them, and what must carry them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import reduce
from graphlib import CycleError, TopologicalSorter
from itertools import product
from typing import NamedTuple

from demandops.base import naming
from demandops.base.errors import Fault, fault, suggestion
from demandops.base.naming import Subject, SubjectKind, TopicKey
from demandops.base.quoting import quoted
from demandops.connections.connection import RouteKey
from demandops.model.config.appdef import Service, named_outputs
from demandops.model.config.config import Config
from demandops.model.demand.demand import AnyDemand, Application, Demand, InputTopic, Item
from demandops.model.ledger.claim import ClaimKey
from demandops.model.ledger.ledger import ClaimChange, Ledger
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
        name: pattern.replace("{instance}", instance)
        for name, pattern in sorted(service.outputs.items())
    }


def distinguishing_text(config: Config, role: str, topic: InputTopic, version: str) -> str:
    """Return the text that makes topic names differ although their source is the same."""
    usual = usual_topic(config, topic.source, role)
    further = topic.further if usual is None else topic.topic != usual
    return " ".join(filter(None, (topic.topic if further else "", version)))


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
            booked_usual = ledger.keys_with("usual", topic.source, role)
            if place not in first and any(key.demand != own for key in booked_usual):
                return True
            usual = first.setdefault(place, topic.topic)
        return topic.topic != usual

    # A usual topic that is booked stays the usual one, even if the request lists it after others.
    for app, role in product(request.applications, config.roles_with_services):
        for topic in app.inputs.get(role, ()):
            booked = ledger.booked_input(role, topic.source, topic.topic)
            if booked is not None and not booked.further:
                first.setdefault((role, topic.source), topic.topic)
    return request.with_each(lambda app: _marked(app, config, is_further))


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


def _marked(
    app: Application, config: Config, is_further: Callable[[str, InputTopic], bool]
) -> Application:
    marked = {  # inputs that may have a service instance of their own
        role: tuple(replace(topic, further=is_further(role, topic)) for topic in app.inputs[role])
        for role in config.roles_with_services
        if role in app.inputs
    }
    return app.with_inputs({**app.inputs, **marked})


# ---- flows: which topics the services of an application read, and where they come from ----
#
# The flows of a demand follow from its own applications and the configuration, never from other
# demands. So the routes that a demand needs are claimed by it and end with it (:mod:`.carriers`).


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

    ``name`` is an input role of the application, or ``<service>.<output>``. ``root`` is the key of
    the demanded topic because of which the flow is needed; it is empty for a delivery, and if no
    single topic needs the flow. ``delivery`` is the position in ``deliver`` of the delivery that
    needs the flow. ``type`` is the message type; it is empty unless the demand names the type.
    """

    name: str
    key: RouteKey
    root: TopicKey = ()
    delivery: int | None = None
    type: str = ""


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
    return app.version if app.separate and not service.shared else ""


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
        yield PublishedTopic(InputTopic(pattern.replace("{instance}", instance), node), node)
        return
    version = version_of_instance(app, producer)
    for role in producer.roots:
        for topic in app.inputs.get(role, ()):
            text = distinguishing_text(config, role, topic, version) if producer.root else ""
            node = topic.source if producer.at_source else node_of(app, producer, topic.source)
            instance = naming.topic_part(topic.source, text)
            made = InputTopic(pattern.replace("{instance}", instance), topic.source)
            yield PublishedTopic(made, node, (role, topic.topic, topic.source))


def flows(config: Config, app: Application) -> list[Flow]:
    """Return the flows between nodes by ``name``; a node that is not chosen yet is empty."""
    services = config.services.get(app.appdef, {})
    # Several services of one node may read a topic, but it must come to the node only once.
    needed: dict[RouteKey, Flow] = {}
    for service in services.values():
        for node, part in _parts(app, service):
            for origin in service.inputs.values():
                for topic, sender, root in topics_of_origin(config, part, origin):
                    if sender != node:
                        cause = root or (next(part.topic_keys()) if service.roots else ())
                        key = RouteKey(sender, topic.topic, node, topic.topic)
                        needed.setdefault(key, Flow(origin, key, cause, type=topic.type))
    made = named_outputs(services) if app.deliver else ()
    for index, delivery in enumerate(app.deliver):
        if delivery.output not in made:
            continue  # admission reports an unknown output
        for topic, sender, _ in topics_of_origin(config, app, delivery.output):
            target = delivery.topic or topic.topic
            key = RouteKey(sender, topic.topic, delivery.node, target)
            if key[:2] != key[2:]:
                needed.setdefault(key, Flow(delivery.output, key, delivery=index))
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


def is_bridged(key: RouteKey, config: Config) -> bool:
    # The initial deployment keeps topic names, so it carries no route that renames a topic.
    node = config.nodes.get(key.sender)
    bridged = node.bridged.get(key.receiver, ()) if node else ()
    return key.topic == key.target and key.topic in bridged


def flows_without_carrier(config: Config, app: Application, ledger: Ledger) -> Iterator[Flow]:
    for flow in flows(config, app):
        is_brought = ledger.ids_with("brings", flow.key.receiver, flow.key.target)
        if not is_brought and not is_bridged(flow.key, config):
            yield flow


# ---- applications on applications: inputs that are outputs of other applications ----
#
# Such an input becomes the topics of the output, on the nodes that publish them. Its demand holds
# the other application too, so that the topics last as long as the demand. What it holds is a claim
# like any other, marked with who reads it.


def reads_outputs(request: Demand) -> bool:
    return request.adds_claims and any(app.read_outputs for app in request.applications)


def with_topics_of_outputs(
    request: AnyDemand, ledger: Ledger, config: Config
) -> tuple[AnyDemand, list[Fault]]:
    """Return the request with the topics of the outputs that its inputs name, and the faults.

    A topic has no source yet if the node of a listed application is still open. All inputs are
    marked as usual or further, because the names of outputs follow from these marks.
    """
    if not reads_outputs(request):
        return with_further_topics(request, ledger, config), []

    listed = _listed(request)

    def id_of(name: str) -> str:  # perhaps listed in a version that runs as a separate instance
        separate = (id for id, app in listed.items() if app.separate and id.startswith(f"{name}@"))
        return name if name in listed else next(separate, name)

    # Who reads whom, also by the claims of others: none of them may close a cycle.
    graph, todo = dict[str, list[str]](), [*listed]
    while todo:
        if (id := todo.pop()) not in graph:
            claims = ledger.application_claims(id)
            apps = [claim.application for claim in claims if claim.demand != request.demand]
            apps += [listed[id]] if id in listed else []
            graph[id] = sorted({id_of(read) for app in apps for read in app.read_outputs})
            todo += graph[id]
    order = TopologicalSorter(graph)
    try:
        order.prepare()
    except CycleError as error:
        *ring, _ = reversed(error.args[1])  # each reads the next
        item = next((i for i in request.demanded if i.held.id in ring), request.demanded[0])
        start = ring.index(item.held.id) if item.held.id in ring else 0
        ids = [quoted(id) for id in (*ring[start:], *ring[: start + 1])]
        message = ", which reads ".join((f"{ids[0]} reads an output of {ids[1]}", *ids[2:]))
        remedy = "read none that depends on this application's own"
        return request, [item.fault("inputs", f"{message}; {remedy}", code="conflict")]

    def producer(name: str) -> Application | Fault:
        id = id_of(name)
        if app := listed.get(id) or _as_booked(id, request.demand, ledger, config):
            return app
        close = suggestion(name, {*listed, *ledger.subjects(SubjectKind.APPLICATION)})
        message = f"{quoted(name)} is neither listed in this demand nor booked{close}"
        return fault(".application", message, code="unknown-application")

    # First those that read no outputs, then those that read only theirs, and so on.
    faults, complete = list[Fault](), dict[int, Item]()
    while order.is_active():
        order.done(*(ready := {*order.get_ready()}))
        for index, item in enumerate(request.demanded):
            if isinstance(item.held, Application) and item.held.id in ready:
                app, problems = _with_topics(item.held, producer, config)
                complete[index] = replace(item, held=app)
                faults += (item.fault(p.field, p.message, code=p.code) for p in problems)
        marked = replace(request, demanded=tuple(complete.values()))
        marked = with_further_topics(marked, ledger, config)
        complete = dict(zip(complete, marked.demanded, strict=True))
        listed |= _listed(marked)
    demanded = (complete.get(index, item) for index, item in enumerate(request.demanded))
    return replace(request, demanded=tuple(demanded)), faults


def _listed(request: Demand) -> dict[str, Application]:
    return {app.id: app for app in request.applications}


def _with_topics(
    app: Application, producer: Callable[[str], Application | Fault], config: Config
) -> tuple[Application, list[Fault]]:
    problems, inputs = list[Fault](), dict[str, tuple[InputTopic, ...]]()
    for role, topics in app.inputs.items():
        kept, more, read = list[InputTopic](), list[InputTopic](), set[tuple[str, str]]()
        for index, topic in enumerate(topics):
            output = (topic.application, topic.output)
            if not topic.application:
                kept.append(topic)
            elif output not in read:
                read.add(output)
                made = _topics_of(topic, producer(topic.application), config)
                if isinstance(made, Fault):
                    where = f"inputs.{role}[{index}]{made.field}"
                    problems.append(replace(made, field=where))
                    made = [each for each in topics if (each.application, each.output) == output]
                kept.append(made[0])
                more += made[1:]  # at the end, so that the others keep their places in the demand
        inputs[role] = (*kept, *more)
    return app.with_inputs(inputs), problems


def _topics_of(
    read: InputTopic, app: Application | Fault, config: Config
) -> list[InputTopic] | Fault:
    if isinstance(app, Fault) or app.appdef not in config.services:
        return app if isinstance(app, Fault) else [read]  # admission reports its type
    outputs = named_outputs(config.services[app.appdef])
    meant = [each for each in outputs if read.output in (each, each.partition(".")[2])]
    if len(meant) != 1:
        close = suggestion(read.output, outputs) or f"; {app.appdef} has none"
        several = f"is an output of several services; write {' or '.join(meant)}"
        problem = several if meant else f"is not an output of {quoted(app.id)}{close}"
        return fault(".output", f"{quoted(read.output)} {problem}")
    message = f"{meant[0]} of {quoted(app.id)} has no topic, because nothing is demanded for it"
    return [
        InputTopic(made.topic.topic, made.node, read.type, False, app.id, meant[0])
        for made in topics_of_origin(config, app, meant[0])
    ] or fault(".output", f"{message}; demand that first, or name another output")


def _as_booked(id: str, demand: str, ledger: Ledger, config: Config) -> Application | None:
    """Return what a demand that reads an application's outputs holds of it.

    It is all that others demand. What they only hold for readers, and what the demand held so far,
    counts only if nobody demands the application any longer: else a topic would never end.
    """
    if not (claims := ledger.application_claims(id)):
        return None
    demanded = [c for c in claims if c.demand != demand and not c.application.held_for]
    versions = config.application_versions.get(claims[0].application.appdef, {})
    apps = sorted(
        (claim.application for claim in demanded or claims),
        key=lambda app: versions[app.version].rank if app.version in versions else (),
    )
    united = reduce(Application.extended, apps)  # in the newest version
    united = replace(united, parameters={}, deliver=(), held_for={}).booked()
    return united.moved_to_nodes_of(claims[0].application)


def with_held_applications(request: AnyDemand, ledger: Ledger, config: Config) -> AnyDemand:
    """Return the request with the applications that it does not list, but whose outputs it reads.

    Their parameters and deliveries stay those of their own demands.
    """
    listed, held = _listed(request), dict[str, tuple[Item, Application]]()
    readers: dict[str, dict[str, tuple[str, ...]]] = {}
    reading = [(i, i.held) for i in request.demanded if isinstance(i.held, Application)]
    for item, reader in reading:  # grows by what they hold
        for id, outputs in reader.read_outputs.items():
            if id in listed:
                continue
            readers.setdefault(id, {})[reader.id] = outputs
            if id not in held and (app := _as_booked(id, request.demand, ledger, config)):
                places = item.places or (f"{item.field}.inputs",)
                held[id] = replace(item, places=places, is_listed=False), app
                reading.append(held[id])
    more = (replace(i, held=replace(app, held_for=readers[app.id])) for i, app in held.values())
    return replace(request, demanded=(*request.demanded, *more))


def without_idle_holds(
    ledger: Ledger, changes: Iterable[ClaimChange]
) -> tuple[Ledger, list[ClaimKey]]:
    """Return the ledger in which the changed demands hold applications only for readers they have.

    A decommission, and a lease that ends in one access domain, may take the reader alone.
    """
    keys = list[ClaimKey]()
    for demand in dict.fromkeys(change.key.demand for change in changes if change.before):
        while idle := [  # again, because what was held may have held more
            (claim, readers)
            for claims in [ledger.claims_with("demand", demand)]
            for holding in [{claim.subject.id for claim in claims if claim.is_on_application}]
            for claim in claims
            if claim.is_on_application and (held_for := claim.application.held_for)
            for readers in [{id: held_for[id] for id in held_for if id in holding}]
            if readers != held_for
        ]:
            for claim, readers in idle:
                left = replace(claim, held=replace(claim.application, held_for=readers))
                ledger = ledger.replace(claim.key, left if readers else None)
                keys.append(claim.key)
    return ledger, keys


def with_booked_outputs(
    app: Application, demand: str, ledger: Ledger, config: Config
) -> Application:
    """Return a booked application with the topics that the outputs it reads have in ``ledger``."""

    def producer(id: str) -> Application | Fault:
        claim = ledger.get(ClaimKey(Subject(SubjectKind.APPLICATION, id), demand))
        return claim.application if claim else fault("", "")

    item = Item(_with_topics(app, producer, config)[0], ())
    put = with_further_topics(Demand("put", demand=demand, demanded=(item,)), ledger, config)
    return _listed(put)[app.id].booked()
