"""Permission: the check that requesters may demand this, on these nodes, for this long.

The access domains of the nodes decide. Every refusal names the rule.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.config.policy import AccessDomain, Rule, matches, seconds_of
from demandops.connections.connection_type import ConnectionType, Ends
from demandops.demand.claim import ApplicationClaim
from demandops.demand.demand_request import (
    ApplicationDemand,
    ConnectionDemand,
    DemandRequest,
    Operation,
)
from demandops.demand.lease import Term
from demandops.errors import Fault, fault

Access = list[tuple[str, str]]
"""Fields of a rule (``nodes``, ``applications``) and the values that a demand needs in them."""


def faults(request: DemandRequest, config: Config) -> Iterator[Fault]:
    """Yield a fault for everything that the access domains do not allow the requesters.

    A release needs no permission. :mod:`demandops.demand.admission` reports nodes without a domain.
    """
    if not request.operation.adds_claims:
        return
    for index, app in enumerate(request.applications):
        where = f"applications[{index}]"
        for domain, access in access_of_application(app, config):
            yield from _not_allowed(where, app.requesters, domain, access)
        home = config.domain_of.get(app.node)
        if home is not None:
            yield from _too_long(request, home)
    for index, connection in enumerate(request.connections):
        where = f"connections[{index}]"
        for domain, access in access_of_connection(connection, connection.chosen_type, config):
            yield from _not_allowed(where, connection.requesters, domain, access)
        home = config.domain_of.get(connection.target)
        if home is not None:
            yield from _too_long(request, home)


def access_of_application(
    app: ApplicationDemand | ApplicationClaim, config: Config
) -> Iterator[tuple[AccessDomain, Access]]:
    """Yield the access that an application needs to the access domain of each of its nodes."""
    for node in _service_nodes(app, config):
        domain = config.domain_of.get(node)
        if domain is not None:
            yield domain, [("applications", app.appdef), ("nodes", node)]


def _service_nodes(app: ApplicationDemand | ApplicationClaim, config: Config) -> Iterable[str]:
    """Return the nodes on which services of an application run: its node, and sources."""
    appdef = config.appdefs.get(app.appdef)
    services = appdef.services.values() if appdef else ()
    roles = [service.each for service in services if service.placement == "source"]
    sources = (topic.source for role in roles for topic in app.inputs.get(str(role), ()))
    return dict.fromkeys((app.node, *sources))


def access_of_connection(
    ends: Ends, kind: ConnectionType | None, config: Config
) -> Iterator[tuple[AccessDomain, Access]]:
    """Yield the access that a connection needs to the access domain of each end."""
    more = kind.access(ends, config) if kind else []
    for node in dict.fromkeys((ends.source, ends.target)):
        domain = config.domain_of.get(node)
        if domain is not None:
            yield domain, [("nodes", node), *more]


def _not_allowed(
    where: str,
    requesters: Iterable[str],
    domain: AccessDomain,
    access: Access,
) -> Iterator[Fault]:
    """Yield a fault for each requester without a rule of the domain that grants the access."""
    for index, requester in enumerate(requesters if domain.rules else ()):
        own = [rule for rule in domain.rules if matches(requester, rule.requesters)]
        misses = [first_uncovered(rule, access) for rule in own]
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


def first_uncovered(rule: Rule, access: Access) -> tuple[str, str] | None:
    """Return the first access that a rule does not grant, or ``None`` if it grants all."""
    return next(
        ((kind, value) for kind, value in access if not matches(value, getattr(rule, kind))), None
    )


def _too_long(request: DemandRequest, domain: AccessDomain) -> Iterator[Fault]:
    longest = domain.leases.longest
    if longest is None or request.lease_s is None or request.lease_s <= seconds_of(longest):
        return
    yield fault(
        "lease",
        f"is {request.lease_s} s, above leases.longest of access domain '{domain.name}', "
        f"{longest}; request that, and renew",
        code="not-allowed",
    )


def with_lease_terms(request: DemandRequest, config: Config) -> DemandRequest:
    """Return the request with the lease of each subject, by the policy of its domain."""

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
