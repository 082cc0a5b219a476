"""From claims to releases.

:func:`affected` names what a change of claims may have touched, :func:`plan` derives just those
releases: the cost of a demand does not grow with the number of others.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from types import MappingProxyType

from generator.catalog.appdef import ApplicationDefinition, Parameter, Service
from generator.catalog.catalog import Catalog
from generator.catalog.override import Override
from generator.catalog.registry import ChartSource
from generator.demand.claim import ApplicationClaim, Subject, SubjectKind
from generator.demand.request import InputTopic
from generator.errors import Refused, fault
from generator.ledger.ledger import Ledger
from generator.plan import clients, naming, overrides, parameters, scaling
from generator.plan.clients import BridgeKey, EndKey
from generator.plan.place import place
from generator.plan.release import Release, ServiceKey, ServiceRelease
from generator.plan.standing import in_force

ReleaseKey = ServiceKey | EndKey | BridgeKey


def keys_of(
    ledger: Ledger, catalog: Catalog, subject: Subject, *, strict: bool = False
) -> Iterator[ReleaseKey]:
    """Yield what must run because ``subject`` is held and no override denies it.

    Of an application whose definition is gone nobody can say: nothing, or where ``strict`` it is
    refused, for what runs must not stop because somebody deleted a file that it still needs.
    """
    yield from keys_booked(in_force(ledger, catalog), catalog, subject, strict=strict)


def keys_booked(
    ledger: Ledger, catalog: Catalog, subject: Subject, *, strict: bool = False
) -> Iterator[ReleaseKey]:
    """Yield what ``subject`` needs by the claims of ``ledger``, suspended or not."""
    if subject.kind is SubjectKind.CONNECTION:
        yield from clients.keys_of(ledger, subject.id)
        return
    claims = ledger.application(subject.id)
    if not claims:
        return
    known = strict or claims[0].appdef in catalog.appdefs
    appdef = _appdef(catalog, claims[0].appdef) if known else None
    for name, service in (appdef.services if appdef else {}).items():
        if service.each is None:
            yield ServiceKey(name, claims[0].node, application=subject.id)
            continue
        topics = {
            (topic.source, topic.topic)
            for claim in claims
            for topic in claim.inputs.get(service.each, ())
        }
        for source, topic in sorted(topics):
            node = source if service.placement == "source" else claims[0].node
            yield ServiceKey(name, node, source=source, topic=topic)


def affected(
    before: Ledger, after: Ledger, catalog: Catalog, subjects: Iterable[Subject]
) -> tuple[ReleaseKey, ...]:
    """Return every release that a change of ``subjects`` may have added, altered or removed.

    Raises:
        Refused: where the definition of what is to run from now on is gone.
    """
    keys = (
        key
        for subject in subjects
        for ledger in (before, after)
        for key in keys_of(ledger, catalog, subject, strict=ledger is after)
    )
    return tuple(dict.fromkeys(keys))


def all_keys(ledger: Ledger, catalog: Catalog) -> tuple[ReleaseKey, ...]:
    """Return every release that the ledger asks for.

    Raises:
        Refused: where the definition of an application that is held is gone.
    """
    subjects = [Subject(kind, id) for kind in SubjectKind for id in ledger.subjects(kind)]
    keys = (key for s in subjects for key in keys_of(ledger, catalog, s, strict=True))
    return tuple(dict.fromkeys(keys))


def plan(ledger: Ledger, catalog: Catalog, key: ReleaseKey) -> Release | None:
    """Return the release at ``key`` as overrides shape it, or nothing where no claim needs it.

    Raises:
        Refused: where claims contradict each other in a parameter, or what a claim names is no
            longer in the catalog.
    """
    ledger = in_force(ledger, catalog)
    release = _unshaped(ledger, catalog, key)
    return overrides.shaped(release, ledger, catalog) if release else None


def denied(ledger: Ledger, catalog: Catalog, key: ReleaseKey) -> tuple[Release, Override] | None:
    """Return the release that is needed at ``key`` and the override that denies it, or nothing."""
    ledger = in_force(ledger, catalog)
    release = _unshaped(ledger, catalog, key)
    by = overrides.denying(release, ledger, catalog) if release else None
    return (release, by) if release and by else None


def _unshaped(ledger: Ledger, catalog: Catalog, key: ReleaseKey) -> Release | None:
    if isinstance(key, EndKey):
        return clients.end(ledger, catalog, key)
    if isinstance(key, BridgeKey):
        return clients.bridge(ledger, catalog, key)
    return _service(ledger, catalog, key)


def _service(ledger: Ledger, catalog: Catalog, key: ServiceKey) -> ServiceRelease | None:
    named = (key.application,) if key.application is not None else None
    users = tuple(  # an application may run elsewhere by now, or as something else
        application
        for application in named or ledger.taking(str(key.source), str(key.topic))
        if key in keys_of(ledger, catalog, Subject(SubjectKind.APPLICATION, application))
    )
    claims = tuple(claim for user in users for claim in ledger.application(user))
    if not claims:
        return None
    appdef = _appdef(catalog, claims[0].appdef)
    service = appdef.services[key.service]
    node, domain = place(catalog, key.node)
    if service.each is not None:
        claims = tuple(claim for claim in claims if _takes(claim, service.each, key))
        inputs = {service.each: _shared_input(claims, service.each, key)}
    else:
        inputs = _application_inputs(catalog, appdef, service, claims)
    definitions: dict[str, Parameter] = {}
    for name in sorted({claim.appdef for claim in claims}, reverse=True):
        definitions |= _appdef(catalog, name).parameters
    values = parameters.merged(definitions, claims)
    return ServiceRelease(
        key=key,
        name=service_name(catalog, service, key),
        node=node,
        domain=domain,
        appdef=min(
            name
            for name, known in catalog.appdefs.items()
            if known.services.get(key.service) == service
        ),
        service=service,
        chart=_chart(catalog, service, claims),
        inputs=MappingProxyType(inputs),
        outputs=MappingProxyType(outputs(catalog, service, key)),
        parameters=MappingProxyType(values),
        replicas=scaling.replicas(service.scaling, sum(map(len, inputs.values()))),
        applications=users,
        requesters=_requesters(claims),
    )


def _chart(catalog: Catalog, service: Service, claims: Iterable[ApplicationClaim]) -> ChartSource:
    """Return the chart in the version that the claims ask for, the default where it has none.

    Raises:
        Refused: where applications that share the service ask for different ones.
    """
    chart = catalog.charts[service.chart]
    asked = {claim.version: chart.at(claim.version) or chart for claim in claims}
    if len({source.version for source in asked.values()}) > 1:
        versions = " and ".join(
            f"{source.version} (for '{version}')" for version, source in sorted(asked.items())
        )
        message = (
            f"{service.chart} is shared and asked for in versions {versions}; ask for the same"
        )
        raise Refused([fault("version", message, code="conflict")])
    return next(iter(asked.values()))


def _requesters(claims: Iterable[ApplicationClaim]) -> tuple[str, ...]:
    return tuple(sorted({who for claim in claims for who in claim.requesters}))


def _takes(claim: ApplicationClaim, role: str, key: ServiceKey) -> bool:
    return any(
        (topic.source, topic.topic) == (key.source, key.topic)
        for topic in claim.inputs.get(role, ())
    )


def _shared_input(
    claims: Iterable[ApplicationClaim], role: str, key: ServiceKey
) -> tuple[InputTopic, ...]:
    types = {
        topic.type
        for claim in claims
        for topic in claim.inputs.get(role, ())
        if (topic.source, topic.topic) == (key.source, key.topic) and topic.type
    }
    return (InputTopic(str(key.topic), str(key.source), min(types, default="")),)


def _application_inputs(
    catalog: Catalog,
    appdef: ApplicationDefinition,
    service: Service,
    claims: tuple[ApplicationClaim, ...],
) -> dict[str, tuple[InputTopic, ...]]:
    inputs: dict[str, tuple[InputTopic, ...]] = {}
    for role, origin in sorted(service.inputs.items()):
        producer_name, _, output = origin.partition(".")
        if not output:
            inputs[role] = _united(claims, origin)
            continue
        producer = appdef.services[producer_name]
        found = set()
        for topic in _united(claims, str(producer.each)):
            node = topic.source if producer.placement == "source" else claims[0].node
            key = ServiceKey(producer_name, node, source=topic.source, topic=topic.topic)
            found.add(InputTopic(outputs(catalog, producer, key)[output], topic.source))
        inputs[role] = tuple(sorted(found))
    return inputs


def _united(claims: Iterable[ApplicationClaim], role: str) -> tuple[InputTopic, ...]:
    types: dict[tuple[str, str], set[str]] = {}
    for claim in claims:
        for topic in claim.inputs.get(role, ()):
            types.setdefault((topic.topic, topic.source), set()).add(topic.type)
    return tuple(InputTopic(*key, max(found)) for key, found in sorted(types.items()))


def service_name(catalog: Catalog, service: Service, key: ServiceKey) -> str:
    """Return the release name of a service instance.

    A source's usual topic (``topics`` of its inventory entry) needs no mention:
    ``od-edge-vehicle00``. Others carry a slug of the topic.
    """
    if key.application is not None:
        return naming.object_name(service.prefix, key.application)
    source, topic = str(key.source), str(key.topic)
    if _is_usual(catalog, service, source, topic):
        return naming.object_name(service.prefix, key.node, source)
    return naming.object_name(service.prefix, key.node, source, topic)


def _is_usual(catalog: Catalog, service: Service, source: str, topic: str) -> bool:
    node = catalog.nodes.get(source)
    return node is not None and node.topics.get(str(service.each)) == topic


def outputs(catalog: Catalog, service: Service, key: ServiceKey) -> dict[str, str]:
    """Return the topics that a service instance publishes, by the appdef's name for each."""
    if key.application is not None:
        instance = naming.topic_part(key.application)
    elif _is_usual(catalog, service, str(key.source), str(key.topic)):
        instance = naming.topic_part(str(key.source))
    else:
        instance = naming.topic_part(str(key.source), str(key.topic))
    return {
        name: pattern.replace("{instance}", instance)
        for name, pattern in sorted(service.outputs.items())
    }


def _appdef(catalog: Catalog, name: str) -> ApplicationDefinition:
    appdef = catalog.appdefs.get(name)
    if appdef is None:
        raise Refused(
            [
                fault(
                    "appdef",
                    f"'{name}' is in use, but appdefs/{name} is gone; restore it",
                    code="unknown-application",
                ).within(f"appdefs/{name}/appdef.yaml")
            ]
        )
    return appdef
