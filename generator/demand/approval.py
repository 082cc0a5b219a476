"""Approval: does a person have to agree before these claims are booked?

Asked by an access domain, by the rules of one, or by an application definition. Knows nothing of
how a person is asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from generator.catalog.catalog import Catalog
from generator.catalog.policy import AccessDomain, matches
from generator.demand.claim import ApplicationClaim, Claim, ConnectionClaim
from generator.demand.lease import Term
from generator.demand.permission import asked_at_ends, missing, places
from generator.demand.request import ConnectionType, DemandRequest

Asked = Iterable[tuple[str, str]]


def asked_by(claims: Iterable[Claim], catalog: Catalog) -> tuple[str, ...]:
    """Return what asks for approval of the claims, each once: ``access domain 'edge'``."""
    found = (who for claim in claims for who in _asked_by(claim, catalog))
    return tuple(dict.fromkeys(found))


def _asked_by(claim: Claim, catalog: Catalog) -> Iterator[str]:
    if isinstance(claim, ApplicationClaim):
        appdef = catalog.appdefs.get(claim.appdef)
        if appdef is not None and appdef.approval == "required":
            yield f"application definition '{appdef.name}'"
    for domain, asked in _asks(claim, catalog):
        for requester in claim.requesters:
            yield from _of_domain(domain, requester, list(asked))


def _asks(claim: Claim, catalog: Catalog) -> Iterator[tuple[AccessDomain, Asked]]:
    """Yield what a claim asks of each access domain that it touches."""
    if isinstance(claim, ConnectionClaim):
        mqtt = claim.type is ConnectionType.MQTT
        yield from asked_at_ends(claim.source, claim.target, claim.broker, mqtt, catalog)
        return
    for node in places(claim, catalog):
        domain = catalog.domain_of.get(node)
        if domain is not None:
            yield domain, (("applications", claim.appdef), ("nodes", node))


def _of_domain(domain: AccessDomain, requester: str, asked: Asked) -> Iterator[str]:
    """Yield what asks for approval, unless one rule lets the requester have it without."""
    rules = [
        rule
        for rule in domain.rules
        if matches(requester, rule.requesters) and missing(rule, asked) is None
    ]
    if any((rule.approval or domain.approval) == "none" for rule in rules):
        return
    own = [rule for rule in rules if rule.approval == "required"]
    for rule in own:
        yield f"rule '{rule.name}' of access domain '{domain.name}'"
    if not own and domain.approval == "required":
        yield f"access domain '{domain.name}'"


def proposed(request: DemandRequest) -> DemandRequest:
    """Return a request whose leases count from the approval, not from when it was received."""

    def waiting(term: Term | None) -> Term | None:
        return replace(term, on_approval=True) if term else None

    return replace(
        request,
        applications=tuple(replace(a, term=waiting(a.term)) for a in request.applications),
        connections=tuple(replace(c, term=waiting(c.term)) for c in request.connections),
    )
