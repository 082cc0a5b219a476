"""Quotas: does a booking leave more than an access domain allows?"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from generator.catalog.catalog import Catalog
from generator.catalog.policy import AccessDomain
from generator.demand.claim import ApplicationClaim, Claim, Subject, SubjectKind
from generator.errors import Fault, fault
from generator.ledger.ledger import Changes, Ledger
from generator.plan.planner import keys_of
from generator.plan.release import ServiceKey


def faults(before: Ledger, after: Ledger, changes: Changes, catalog: Catalog) -> Iterator[Fault]:
    """Yield every quota that ``changes`` go beyond; what was over it before may stay and shrink."""
    booked = [change.after for change in changes.claims if change.after]
    holders = {(_node(claim), who) for claim in booked for who in claim.requesters}
    domains = {
        (found.name, who): found for node, who in holders if (found := catalog.domain_of.get(node))
    }
    for (_, requester), domain in sorted(domains.items(), key=lambda pair: pair[0]):
        yield from _claims(requester, before, after, domain, catalog)
    touched = [c.after or c.before for c in changes.claims]
    for node in sorted(_nodes(claim for claim in touched if claim)):
        yield from _services(node, before, after, catalog)


def _claims(
    requester: str, before: Ledger, after: Ledger, domain: AccessDomain, catalog: Catalog
) -> Iterator[Fault]:
    most = domain.quotas.claims_per_requester
    if most is None:
        return
    count = _held(requester, after, domain, catalog)
    if count > most and count > _held(requester, before, domain, catalog):
        yield _over(domain, "claimsPerRequester", most, f"'{requester}' would hold {count} claims")


def _held(requester: str, ledger: Ledger, domain: AccessDomain, catalog: Catalog) -> int:
    claims = ledger.of_requester(requester)
    return sum(catalog.domain_of.get(_node(claim)) is domain for claim in claims)


def _services(node: str, before: Ledger, after: Ledger, catalog: Catalog) -> Iterator[Fault]:
    domain = catalog.domain_of.get(node)
    most = domain.quotas.services_per_node if domain else None
    if domain is None or most is None:
        return
    count = _running(node, after, catalog)
    if count > most and count > _running(node, before, catalog):
        yield _over(domain, "servicesPerNode", most, f"'{node}' would run {count} services")


def _running(node: str, ledger: Ledger, catalog: Catalog) -> int:
    applications = (Subject(SubjectKind.APPLICATION, name) for name in ledger.at_node(node))
    keys = {key for subject in applications for key in keys_of(ledger, catalog, subject)}
    return sum(isinstance(key, ServiceKey) and key.node == node for key in keys)


def _over(domain: AccessDomain, quota: str, most: int, what: str) -> Fault:
    return fault(
        "",
        f"{what}, and quotas.{quota} of access domain '{domain.name}' allows {most}; release "
        "something first, or have policy/ changed",
        code="quota",
    )


def _node(claim: Claim) -> str:
    """Return where a claim counts: where the application runs or the connection leads."""
    return claim.node if isinstance(claim, ApplicationClaim) else claim.target


def _nodes(claims: Iterable[Claim]) -> set[str]:
    nodes = set()
    for claim in claims:
        if isinstance(claim, ApplicationClaim):
            nodes |= {claim.node, *(topic.source for _, topic in claim.all_inputs())}
    return nodes
