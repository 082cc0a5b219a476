"""The flow of topics through an application: which topics services read, and where they come from.

The flows of a demand follow from its own applications and the configuration, never from other
demands. So the connections that a demand needs are claimed by it and end with it.
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
    input from which services make ``topic``. It is empty if a service makes ``topic`` from all its
    inputs together.
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
        """Whether a service makes the topic; if not, the demand lists it as an input."""
        return "." in self.name


def node_of(app: Application, service: Service, source: str) -> str:
    """Return the node where a service of an application runs for inputs from ``source``.

    The result is empty if no node is chosen for the service yet, or if the service runs once for
    each cluster and has no node in the application's cluster.
    """
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
    """Return the ``version`` in the keys of a service's instances.

    It is the version of the application if this is a separate instance, and empty otherwise.
    """
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
    """Yield the topics of an application that ``origin`` names.

    ``origin`` is an input role of the application, or ``<service>.<output>`` of its definition.
    """
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
    """Return the flows that an application needs between nodes, sorted by ``name``.

    The result is empty if the application definition is missing. A node that is not chosen yet is
    an empty text.
    """
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
    """Yield (node, application with only the inputs of this instance) for each instance."""
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
