"""Quotas of an access domain: claims for each requester, and services on each node.

A booking that does not raise an exceeded count is allowed. The quota ``demandsPerMinute`` is
checked elsewhere (:mod:`demandops.service.timing.rate_limit`).
"""

from __future__ import annotations

from collections.abc import Iterator

from demandops.config.policy import AccessDomain
from demandops.errors import Fault, fault
from demandops.ledger.claim_changes import Changes
from demandops.ledger.world import World
from demandops.plan.overrides.claim_overrides import without_suspended
from demandops.plan.release import ServiceKey
from demandops.plan.release_keys import is_needed, keys_of
from demandops.subject import Subject, SubjectKind


def faults(before: World, after: World, changes: Changes) -> Iterator[Fault]:
    """Yield a fault for each quota that the booking exceeds.

    If a quota was exceeded before, there is a fault only if the booking raises the count further.
    Suspended claims count as claims, but nothing runs for them.
    """
    domain_of = after.config.domain_of
    booked = [change.after for change in changes.claims if change.after]
    holders = {(claim.held.home, who) for claim in booked for who in claim.requesters}
    domains = {(found.name, who): found for node, who in holders if (found := domain_of.get(node))}
    for (_, requester), domain in sorted(domains.items(), key=lambda pair: pair[0]):
        yield from _claims(requester, before, after, domain)
    touched = [claim for c in changes.claims if (claim := c.after or c.before)]
    apps = [claim.application for claim in touched if claim.is_on_application]
    nodes = {node for app in apps for node in app.needed_nodes()}
    nodes |= {
        one.runs_at[app.node]
        for app in apps
        for one in after.config.services.get(app.appdef, {}).values()
        if app.node in one.runs_at
    }
    for node in sorted(nodes):
        yield from _services(node, before, after)


def _claims(requester: str, before: World, after: World, domain: AccessDomain) -> Iterator[Fault]:
    most = domain.quotas.claims_per_requester
    if (
        most is None or after.ledger.count_of_requester(requester) <= most
    ):  # this counts the claims in all domains, so at least as many as those in this domain
        return
    count = _held(requester, after, domain)
    if count > most and count > _held(requester, before, domain):
        yield _exceeded(
            domain, "claimsPerRequester", most, f"'{requester}' would hold {count} claims"
        )


def _held(requester: str, world: World, domain: AccessDomain) -> int:
    claims = world.ledger.claims_of_requester(requester)
    return sum(world.config.domain_of.get(claim.held.home) is domain for claim in claims)


def _services(node: str, before: World, after: World) -> Iterator[Fault]:
    domain = after.config.domain_of.get(node)
    most = domain.quotas.services_per_node if domain else None
    if domain is None or most is None:
        return
    count = _running(node, after)
    if count > most and count > _running(node, before):
        yield _exceeded(domain, "servicesPerNode", most, f"'{node}' would run {count} services")


def _running(node: str, world: World) -> int:
    world = without_suspended(world)
    names = world.ledger.applications_at(node)
    subjects = (Subject(SubjectKind.APPLICATION, name) for name in names)
    keys = {key for subject in subjects for key in keys_of(world, subject)}
    for name, one in world.config.definitions.items():
        key = ServiceKey(name, node, for_cluster=True)
        if node in one.nodes.values() and is_needed(world, key):
            keys.add(key)
    return sum(isinstance(key, ServiceKey) and key.node == node for key in keys)


def _exceeded(domain: AccessDomain, quota: str, most: int, usage: str) -> Fault:
    return fault(
        "",
        f"{usage}, but quotas.{quota} of access domain '{domain.name}' allows {most}; release "
        "something first, or ask for a change of policy/",
        code="quota",
    )
