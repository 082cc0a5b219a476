"""Permission: may these requesters ask for this, here, and for how long?

Holds a request to the access domains of the nodes that it names. Every refusal names the rule.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.config.policy import AccessDomain, Rule, matches, seconds_of
from demandops.demand.claim import ApplicationClaim
from demandops.demand.demand_request import (
    ApplicationDemand,
    ConnectionDemand,
    ConnectionType,
    DemandRequest,
    Operation,
)
from demandops.demand.lease import Term
from demandops.demand.transport_choice import choose_broker
from demandops.errors import Fault, fault


def faults(request: DemandRequest, config: Config) -> Iterator[Fault]:
    """Yield what the access domains do not let its requesters ask for.

    Giving something up needs no permission. Nodes that are in no domain are told elsewhere.
    """
    if not request.operation.adds_claims:
        return
    for index, app in enumerate(request.applications):
        where = f"applications[{index}]"
        for node in service_nodes(app, config):
            domain = config.domain_of.get(node)
            if domain is not None:
                asked = (("applications", app.appdef), ("nodes", node))
                yield from _unruled(where, app.requesters, domain, asked)
        home = config.domain_of.get(app.node)
        if home is not None:
            yield from _too_long(request, home)
    for index, connection in enumerate(request.connections):
        yield from _connection(f"connections[{index}]", connection, config)
        domain = config.domain_of.get(connection.target)
        if domain is not None:
            yield from _too_long(request, domain)


def service_nodes(app: ApplicationDemand | ApplicationClaim, config: Config) -> Iterable[str]:
    """Return the nodes on which services of an application run: its own, and sources."""
    appdef = config.appdefs.get(app.appdef)
    services = appdef.services.values() if appdef else ()
    roles = [service.each for service in services if service.placement == "source"]
    sources = (topic.source for role in roles for topic in app.inputs.get(str(role), ()))
    return dict.fromkeys((app.node, *sources))


def _connection(where: str, asked: ConnectionDemand, config: Config) -> Iterator[Fault]:
    mqtt = asked.type == ConnectionType.MQTT.value
    for domain, asks in access_of_connection(
        asked.source, asked.target, asked.broker, mqtt, config
    ):
        yield from _unruled(where, asked.requesters, domain, asks)


def access_of_connection(
    source: str, target: str, wanted_broker: str, mqtt: bool, config: Config
) -> Iterator[tuple[AccessDomain, list[tuple[str, str]]]]:
    """Yield what a connection asks of the access domain of each of its ends."""
    broker = choose_broker(wanted_broker, source, target, config) if mqtt else None
    for node in dict.fromkeys((source, target)):
        domain = config.domain_of.get(node)
        if domain is None:
            continue
        asks = [("nodes", node)]
        if broker is not None:
            asks.append(("brokers", broker.node))
        yield domain, asks


def _unruled(
    where: str,
    requesters: Iterable[str],
    domain: AccessDomain,
    asked: Iterable[tuple[str, str]],
) -> Iterator[Fault]:
    """Yield a fault for each requester whom no rule of the domain lets ask for this."""
    asked = list(asked)
    for index, requester in enumerate(requesters if domain.rules else ()):
        own = [rule for rule in domain.rules if matches(requester, rule.requesters)]
        misses = [first_uncovered(rule, asked) for rule in own]
        if own and None in misses:
            continue
        place = f"{where}.requesters[{index}]"
        if not own:
            rules = ", ".join(f"{rule.name} ({' '.join(rule.requesters)})" for rule in domain.rules)
            message = (
                f"no rule of access domain '{domain.name}' is for '{requester}'; its rules: {rules}"
            )
        else:
            reasons = "; ".join(
                f"rule '{rule.name}' of access domain '{domain.name}' lets '{requester}' have "
                f"{kind} {' '.join(getattr(rule, kind))}, not '{value}'"
                for rule, (kind, value) in zip(own, filter(None, misses), strict=True)
            )
            message = f"{reasons}; ask for what is allowed, or have policy/ changed"
        yield fault(place, message, code="not-allowed")


def first_uncovered(rule: Rule, asked: Iterable[tuple[str, str]]) -> tuple[str, str] | None:
    """Return the first thing asked that a rule does not cover; nothing where it covers all."""
    return next(
        ((kind, value) for kind, value in asked if not matches(value, getattr(rule, kind))), None
    )


def _too_long(request: DemandRequest, domain: AccessDomain) -> Iterator[Fault]:
    longest = domain.leases.longest
    if longest is None or request.lease_s is None or request.lease_s <= seconds_of(longest):
        return
    yield fault(
        "lease",
        f"is {request.lease_s} s, above leases.longest of access domain '{domain.name}', "
        f"{longest}; ask for that, and renew",
        code="not-allowed",
    )


def with_lease_terms(request: DemandRequest, config: Config) -> DemandRequest:
    """Return the request with the lease that each subject gets, by its domain."""

    def term(node: str) -> Term | None:
        domain = config.domain_of.get(node)
        return _term(request, domain) if domain else None

    def app_with(app: ApplicationDemand) -> ApplicationDemand:
        return replace(app, term=term(app.node))

    def connection_with(connection: ConnectionDemand) -> ConnectionDemand:
        return replace(connection, term=term(connection.target))

    return replace(
        request,
        applications=tuple(map(app_with, request.applications)),
        connections=tuple(map(connection_with, request.connections)),
    )


def _term(request: DemandRequest, domain: AccessDomain) -> Term | None:
    policy = domain.leases
    if request.operation is Operation.JOIN and not policy.deployment_requests:
        return None
    given = policy.default or policy.longest
    seconds = request.lease_s or (seconds_of(given) if given else None)
    return Term(seconds, seconds_of(policy.slack)) if seconds else None
