"""Quotas: the limits of an access domain that a booking must not exceed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from demandops.config.config import Config
from demandops.config.policy import AccessDomain
from demandops.demand.application import Application
from demandops.demand.claim import Claim
from demandops.errors import Fault, fault
from demandops.ledger.ledger import Changes, Ledger
from demandops.plan.release import ServiceKey
from demandops.plan.release_keys import keys_of
from demandops.subject import Subject, SubjectKind


def faults(before: Ledger, after: Ledger, changes: Changes, config: Config) -> Iterator[Fault]:
    """Yield a fault for each quota that is exceeded and whose count ``changes`` raised."""
    booked = [change.after for change in changes.claims if change.after]
    holders = {(claim.held.home, who) for claim in booked for who in claim.requesters}
    domains = {
        (found.name, who): found for node, who in holders if (found := config.domain_of.get(node))
    }
    for (_, requester), domain in sorted(domains.items(), key=lambda pair: pair[0]):
        yield from _claims(requester, before, after, domain, config)
    touched = [c.after or c.before for c in changes.claims]
    for node in sorted(_nodes(claim for claim in touched if claim)):
        yield from _services(node, before, after, config)


def _claims(
    requester: str, before: Ledger, after: Ledger, domain: AccessDomain, config: Config
) -> Iterator[Fault]:
    most = domain.quotas.claims_per_requester
    if most is None:
        return
    if after.count_of_requester(requester) <= most:
        return  # in all domains together
    count = _held(requester, after, domain, config)
    if count > most and count > _held(requester, before, domain, config):
        yield _exceeded(
            domain, "claimsPerRequester", most, f"'{requester}' would hold {count} claims"
        )


def _held(requester: str, ledger: Ledger, domain: AccessDomain, config: Config) -> int:
    claims = ledger.claims_of_requester(requester)
    return sum(config.domain_of.get(claim.held.home) is domain for claim in claims)


def _services(node: str, before: Ledger, after: Ledger, config: Config) -> Iterator[Fault]:
    domain = config.domain_of.get(node)
    most = domain.quotas.services_per_node if domain else None
    if domain is None or most is None:
        return
    count = _running(node, after, config)
    if count > most and count > _running(node, before, config):
        yield _exceeded(domain, "servicesPerNode", most, f"'{node}' would run {count} services")


def _running(node: str, ledger: Ledger, config: Config) -> int:
    applications = (Subject(SubjectKind.APPLICATION, name) for name in ledger.applications_at(node))
    keys = {key for subject in applications for key in keys_of(ledger, config, subject)}
    return sum(isinstance(key, ServiceKey) and key.node == node for key in keys)


def _exceeded(domain: AccessDomain, quota: str, most: int, usage: str) -> Fault:
    return fault(
        "",
        f"{usage}, and quotas.{quota} of access domain '{domain.name}' allows {most}; release "
        "something first, or have policy/ changed",
        code="quota",
    )


def _nodes(claims: Iterable[Claim]) -> set[str]:
    held = (claim.held for claim in claims)
    return {node for one in held if isinstance(one, Application) for node in one.needed_nodes()}
