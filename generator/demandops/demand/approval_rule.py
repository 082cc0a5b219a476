"""The approval rules: which claims need a person's approval before they are booked.

An access domain, one of its rules or an application definition can require it. How a person
approves is not known here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.config.policy import AccessDomain, matches
from demandops.demand.application import Application
from demandops.demand.claim import Claim
from demandops.demand.demand_request import AnyRequest, Demanded, DemandRequest
from demandops.demand.permission import Access, first_uncovered, needed_access


def approval_reasons(
    request: DemandRequest, changes: Iterable[tuple[Claim | None, Claim | None]], config: Config
) -> tuple[str, ...]:
    """Return the reasons why a request needs approval, each once: ``access domain 'edge'``.

    Renewals, releases and the claims of overrides need no approval.

    Args:
        request: an admitted request.
        changes: each claim that it changes, before and after the request.
        config: the access domains and application definitions.
    """
    if not request.adds_claims:
        return ()
    listed = set(request.subjects())
    changed = (
        after
        for before, after in changes
        if after and after.subject in listed and _is_more_than_renewed(before, after)
    )
    return tuple(dict.fromkeys(reason for claim in changed for reason in _reasons(claim, config)))


def _is_more_than_renewed(before: Claim | None, after: Claim) -> bool:
    """Return whether a claim is new or differs in more than its lease."""
    return before is None or replace(after, lease=before.lease) != before


def _reasons(claim: Claim, config: Config) -> Iterator[str]:
    if isinstance(claim.held, Application):
        appdef = config.appdefs.get(claim.held.appdef)
        if appdef is not None and appdef.approval == "required":
            yield f"application definition '{appdef.name}'"
    for domain, access in needed_access(claim.held, config):
        for requester in claim.requesters:
            yield from _domain_reasons(domain, requester, access)


def _domain_reasons(domain: AccessDomain, requester: str, access: Access) -> Iterator[str]:
    """Yield the reasons for approval, unless one rule grants the access without approval."""
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


def with_leases_from_approval(request: AnyRequest) -> AnyRequest:
    """Return the request with leases that start at its approval."""

    def from_approval(one: Demanded) -> Demanded:
        return replace(one, term=replace(one.term, on_approval=True)) if one.term else one

    return replace(request, demanded=tuple(map(from_approval, request.demanded)))
