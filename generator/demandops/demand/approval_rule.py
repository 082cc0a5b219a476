"""The approval rules: which claims need a person's approval before they are booked.

An access domain, one of its rules or an application definition can require it. How a person
approves is not known here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.config.policy import AccessDomain, matches
from demandops.demand.claim import ApplicationClaim, Claim, ConnectionClaim, Subject, SubjectKind
from demandops.demand.demand_request import DemandRequest
from demandops.demand.lease import Term
from demandops.demand.permission import (
    Access,
    access_of_application,
    access_of_connection,
    first_uncovered,
)


def approval_reasons(
    request: DemandRequest, changes: Iterable[tuple[Claim | None, Claim | None]], config: Config
) -> tuple[str, ...]:
    """Return what requires approval of a request, each once: ``access domain 'edge'``.

    Renewals, releases and the claims of overrides need no approval.

    Args:
        request: an admitted request.
        changes: each claim that it changes, before and after the request.
        config: the access domains and application definitions.
    """
    if not request.operation.adds_claims:
        return ()
    listed = set(subjects_of(request))
    changed = (
        after
        for before, after in changes
        if after and after.subject in listed and _is_more_than_renewed(before, after)
    )
    return tuple(dict.fromkeys(reason for claim in changed for reason in _reasons(claim, config)))


def subjects_of(request: DemandRequest) -> list[Subject]:
    """Return the applications and connections that a request lists."""
    return [
        *(Subject(SubjectKind.APPLICATION, app.id) for app in request.applications),
        *(Subject(SubjectKind.CONNECTION, one.id) for one in request.connections),
    ]


def _is_more_than_renewed(before: Claim | None, after: Claim) -> bool:
    """Return whether a claim is new or differs in more than its lease."""
    return before is None or replace(after, lease=before.lease) != before


def _reasons(claim: Claim, config: Config) -> Iterator[str]:
    if isinstance(claim, ApplicationClaim):
        appdef = config.appdefs.get(claim.appdef)
        if appdef is not None and appdef.approval == "required":
            yield f"application definition '{appdef.name}'"
    for domain, access in _access(claim, config):
        for requester in claim.requesters:
            yield from _domain_reasons(domain, requester, access)


def _access(claim: Claim, config: Config) -> Iterator[tuple[AccessDomain, Access]]:
    """Yield the access that a claim needs to each access domain."""
    if isinstance(claim, ConnectionClaim):
        yield from access_of_connection(claim, claim.type, config)
    else:
        yield from access_of_application(claim, config)


def _domain_reasons(domain: AccessDomain, requester: str, access: Access) -> Iterator[str]:
    """Yield what requires approval, unless one rule grants the access without it."""
    rules = [
        rule
        for rule in domain.rules
        if matches(requester, rule.requesters) and first_uncovered(rule, access) is None
    ]
    if any((rule.approval or domain.approval) == "none" for rule in rules):
        return
    own = [rule for rule in rules if rule.approval == "required"]
    for rule in own:
        yield f"rule '{rule.name}' of access domain '{domain.name}'"
    if not own and domain.approval == "required":
        yield f"access domain '{domain.name}'"


def with_leases_from_approval(request: DemandRequest) -> DemandRequest:
    """Return the request with leases that start at its approval."""

    def from_approval(term: Term | None) -> Term | None:
        return replace(term, on_approval=True) if term else None

    return replace(
        request,
        applications=tuple(replace(a, term=from_approval(a.term)) for a in request.applications),
        connections=tuple(replace(c, term=from_approval(c.term)) for c in request.connections),
    )
