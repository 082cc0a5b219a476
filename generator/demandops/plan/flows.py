"""The flow of topics through an application: which topics services read, and where they come from.

The flows of a demand follow from its own applications and the configuration, never from other
demands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from demandops import naming
from demandops.config.appdef import Service
from demandops.config.config import Config
from demandops.demand.application import Application, InputTopic
from demandops.plan.output_topics import distinguishing_text, published_topic, topic_name
from demandops.plan.release import ServiceKey
from demandops.subject import TopicKey


class PublishedTopic(NamedTuple):
    """A topic of an application, and the node that publishes the topic.

    ``root`` is the key of the demanded input from which ``topic`` comes: ``topic`` itself, or the
    input from which services make ``topic``. ``root`` is empty if a service makes ``topic`` from
    all its inputs together.
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
    is the position in ``deliver`` of the delivery that needs the flow, or ``None`` if a service
    reads the topic. ``type`` is the message type; it is empty unless the demand names the type.
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
        """Whether a service makes the topic. If not, the demand lists the topic as an input."""
        return "." in self.name


def node_of(app: Application, service: Service, source: str) -> str:
    """Return the node where a service of an application runs for inputs from ``source``.

    The result is an empty text in two cases. Either no node is chosen for the service yet, or the
    service runs once for each cluster and has no node in the application's cluster.
    """
    if service.nodes:
        return service.runs_at.get(app.node, "")
    if service.at_source:
        return source
    return app.moved.get(service.name) or app.chosen_node(service.name)


def instances(app: Application, service: Service) -> Iterator[ServiceKey]:
    """Yield the keys of the instances of a service that an application needs.

    ``node`` of a key is empty if no node is chosen for the service yet.
    """
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
    """Return the ``version`` in the keys of a service's instances.

    If the application is a separate instance, this is the version of the application. It is an
    empty text for any other application, and for a shared service.
    """
    return "" if service.shared else app.own_version


def roots_of(app: Application, service: Service, key: ServiceKey) -> list[TopicKey]:
    """Return the inputs of an application for which a service instance runs, as topic keys."""
    if service.root is not None:
        found = app.inputs_from(service.root, str(key.source), str(key.topic))
        return [(service.root, one.topic, one.source) for one in found]
    topics = ((role, one) for role in service.roots for one in app.inputs.get(role, ()))
    return [(role, one.topic, one.source) for role, one in topics if one.source == key.node]


def topics_of_origin(config: Config, app: Application, origin: str) -> Iterator[PublishedTopic]:
    """Yield the topics of an application that ``origin`` names.

    ``origin`` is an input role of the application, or ``<service>.<output>`` of its definition.
    """
    name, _, output = origin.partition(".")
    if not output:
        for one in app.inputs.get(origin, ()):
            yield PublishedTopic(one, one.source, (origin, one.topic, one.source))
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
        for one in app.inputs.get(role, ()):
            text = distinguishing_text(config, role, one, version) if producer.root else ""
            node = one.source if producer.at_source else node_of(app, producer, one.source)
            yield PublishedTopic(
                published_topic(pattern, one.source, text), node, (role, one.topic, one.source)
            )


def flows(config: Config, app: Application) -> list[Flow]:
    """Return the flows that an application needs between nodes, sorted by ``name``.

    The result is empty if the application definition is missing. A node that is not chosen yet is
    an empty text.
    """
    found: dict[tuple[str, str, str, str], Flow] = {}
    for service in config.services.get(app.appdef, {}).values():
        for node, part in _parts(app, service):
            for origin in service.inputs.values():
                for one in topics_of_origin(config, part, origin):
                    if one.node != node:
                        root = one.root or (next(part.topic_keys()) if service.roots else ())
                        name = one.topic.topic
                        flow = Flow(origin, name, one.node, node, name, root, type=one.topic.type)
                        found.setdefault((name, one.node, node, name), flow)
    for flow in _deliveries(config, app):
        found.setdefault((flow.topic, flow.sender, flow.receiver, flow.target), flow)
    return sorted(found.values(), key=lambda flow: flow.name)


def _deliveries(config: Config, app: Application) -> Iterator[Flow]:
    for index, delivery in enumerate(app.deliver):
        name, _, output = delivery.output.partition(".")
        service = config.services.get(app.appdef, {}).get(name)
        if service is None or output not in service.outputs:
            continue  # admission reports an unknown output
        for one in topics_of_origin(config, app, delivery.output):
            topic = one.topic.topic
            target = delivery.topic or topic
            if (one.node, topic) != (delivery.node, target):
                yield Flow(delivery.output, topic, one.node, delivery.node, target, delivery=index)


def _parts(app: Application, service: Service) -> Iterator[tuple[str, Application]]:
    """Yield (node of the instance, application) for each instance of a service.

    The yielded application has only the inputs for which this instance runs.
    """
    if service.root is not None:
        for one in app.inputs.get(service.root, ()):
            yield node_of(app, service, one.source), app.with_inputs({service.root: (one,)})
    elif service.at_source:
        by_source: dict[str, dict[str, list[InputTopic]]] = {}
        for role in service.roots:
            for one in app.inputs.get(role, ()):
                by_source.setdefault(one.source, {}).setdefault(role, []).append(one)
        for source, inputs in sorted(by_source.items()):
            part = {role: tuple(topics) for role, topics in inputs.items()}
            yield node_of(app, service, source), app.with_inputs(part)
    else:
        yield node_of(app, service, ""), app
