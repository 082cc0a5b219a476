"""The topics that services publish, named as the reference names them.

``{instance}`` in an output pattern stands for the application or the node for which a service runs.
For a service with ``each``, ``{instance}`` stands for the source of the input. A source has one
usual topic for an input role: the topic in the source's inventory entry or, if there is none, the
first topic that a demand booked. Any other topic is a further topic of the source. A name that is
made from a further topic contains the source and this topic. If the inventory names no usual topic,
the claims record which topics are further topics. So a name stays the same while anybody demands
the topic and nobody changes the usual topic in the inventory. The reference's programs subscribe to
outputs by name: with other names, they would hear nothing, without an error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache

from demandops import naming
from demandops.config.appdef import Service
from demandops.config.config import Config
from demandops.demand.application import Application, InputTopic
from demandops.demand.demand_request import AnyRequest, Put
from demandops.ledger.ledger import Ledger
from demandops.plan.release import ServiceKey


def outputs(
    config: Config, service: Service, key: ServiceKey, *, further: bool = False
) -> dict[str, str]:
    """Return the topics that a service instance publishes, by the name of the output.

    ``further`` is true if the instance runs for a further topic of a source. It is ignored if the
    inventory names the usual topic.
    """
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
    """Return the text that makes topic names differ although their source is the same.

    It contains ``topic`` if this is a further topic of its source, and ``version``.
    """
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
    """Return the usual topic of a source that the inventory names for ``role``, or ``None``."""
    node = config.nodes.get(source)
    return node.topics.get(role) if node else None


def with_further_topics(request: AnyRequest, ledger: Ledger, config: Config) -> AnyRequest:
    """Return the request in which ``further`` says for each input whether it is a further topic.

    Only inputs that may have a service instance of their own are marked.
    """
    if not request.adds_claims:
        return request
    # The claims of the put's own demand do not count, because the put may release their topics.
    own = request.demand if isinstance(request, Put) else None
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
    for role, topic in (each for app in apps for each in _per_topic(app, config)):
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
    """Return the ledger with ``further`` set in claims that were read from an earlier format.

    In this format, the files of claims do not say which topics are further topics.
    """
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
        marked.setdefault(role, []).append(topic._replace(further=further))
    return app.with_inputs(
        {**app.inputs, **{role: tuple(topics) for role, topics in marked.items()}}
    )
