"""Approval: does a person have to agree before these claims are booked?

Asked by an access domain, by the rules of one, or by an application definition. Knows nothing of
how a person is asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.config.policy import AccessDomain, matches
from demandops.demand.claim import ApplicationClaim, Claim, ConnectionClaim, Subject, SubjectKind
from demandops.demand.demand_request import ConnectionType, DemandRequest
from demandops.demand.lease import Term
from demandops.demand.permission import access_of_connection, first_uncovered, service_nodes

Asked = Iterable[tuple[str, str]]


def approval_reasons(
    request: DemandRequest, changes: Iterable[tuple[Claim | None, Claim | None]], config: Config
) -> tuple[str, ...]:
    """Return what asks for approval of a request, each once: ``access domain 'edge'``.

    What renews or gives up needs none, nor does what overrides keep beside it.

    Args:
        request: an admitted request.
        changes: each claim that it changes, before and after.
        config: the access domains and application definitions.
    """
    if not request.operation.adds_claims:
        return ()
    listed = set(subjects_of(request))
    asked = (
        after
        for before, after in changes
        if after and after.subject in listed and _says_more(before, after)
    )
    return tuple(dict.fromkeys(who for claim in asked for who in _asked_by(claim, config)))


def subjects_of(request: DemandRequest) -> list[Subject]:
    """Return the applications and connections that a request lists."""
    return [
        *(Subject(SubjectKind.APPLICATION, app.id) for app in request.applications),
        *(Subject(SubjectKind.CONNECTION, one.id) for one in request.connections),
    ]


def _says_more(before: Claim | None, after: Claim) -> bool:
    """Tell whether a claim is new, or differs in more than how long it holds."""
    return before is None or replace(after, lease=before.lease) != before


def _asked_by(claim: Claim, config: Config) -> Iterator[str]:
    if isinstance(claim, ApplicationClaim):
        appdef = config.appdefs.get(claim.appdef)
        if appdef is not None and appdef.approval == "required":
            yield f"application definition '{appdef.name}'"
    for domain, asked in _asks(claim, config):
        for requester in claim.requesters:
            yield from _of_domain(domain, requester, list(asked))


def _asks(claim: Claim, config: Config) -> Iterator[tuple[AccessDomain, Asked]]:
    """Yield what a claim asks of each access domain that it touches."""
    if isinstance(claim, ConnectionClaim):
        mqtt = claim.type is ConnectionType.MQTT
        yield from access_of_connection(claim.source, claim.target, claim.broker, mqtt, config)
        return
    for node in service_nodes(claim, config):
        domain = config.domain_of.get(node)
        if domain is not None:
            yield domain, (("applications", claim.appdef), ("nodes", node))


def _of_domain(domain: AccessDomain, requester: str, asked: Asked) -> Iterator[str]:
    """Yield what asks for approval, unless one rule lets the requester have it without."""
    rules = [
        rule
        for rule in domain.rules
        if matches(requester, rule.requesters) and first_uncovered(rule, asked) is None
    ]
    if any((rule.approval or domain.approval) == "none" for rule in rules):
        return
    own = [rule for rule in rules if rule.approval == "required"]
    for rule in own:
        yield f"rule '{rule.name}' of access domain '{domain.name}'"
    if not own and domain.approval == "required":
        yield f"access domain '{domain.name}'"


def with_leases_from_approval(request: DemandRequest) -> DemandRequest:
    """Return a request whose leases count from the approval, not from when it was received."""

    def waiting(term: Term | None) -> Term | None:
        return replace(term, on_approval=True) if term else None

    return replace(
        request,
        applications=tuple(replace(a, term=waiting(a.term)) for a in request.applications),
        connections=tuple(replace(c, term=waiting(c.term)) for c in request.connections),
    )
