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
    domains = {
        (domain.name, who): domain for node, who in holders if (domain := domain_of.get(node))
    }
    for (_, requester), domain in sorted(domains.items(), key=lambda pair: pair[0]):
        most = domain.quotas.claims_per_requester
        # The ledger counts a requester's claims in all domains, so at least as many as those in
        # this domain. It has this count at hand, so most demands need no search.
        if most is None or after.ledger.count_of_requester(requester) <= most:
            continue
        count = _held(requester, after, domain)
        if count > most and count > _held(requester, before, domain):
            usage = f"'{requester}' would hold {count} claims"
            yield _exceeded(domain, "claimsPerRequester", most, usage)
    touched = [claim for change in changes.claims if (claim := change.after or change.before)]
    apps = [claim.application for claim in touched if claim.is_on_application]
    nodes = {node for app in apps for node in app.needed_nodes()}
    # A service for a cluster runs at a node that only its definition names.
    nodes |= {
        service.runs_at[app.node]
        for app in apps
        for service in after.config.services.get(app.appdef, {}).values()
        if app.node in service.runs_at
    }
    for node in sorted(nodes):
        of_node = domain_of.get(node)
        most = of_node.quotas.services_per_node if of_node else None
        if of_node is None or most is None:
            continue
        count = _running(node, after)
        if count > most and count > _running(node, before):
            usage = f"'{node}' would run {count} services"
            yield _exceeded(of_node, "servicesPerNode", most, usage)


def _held(requester: str, world: World, domain: AccessDomain) -> int:
    claims = world.ledger.claims_of_requester(requester)
    return sum(world.config.domain_of.get(claim.held.home) is domain for claim in claims)


def _running(node: str, world: World) -> int:
    world = without_suspended(world)
    ids = world.ledger.applications_at(node)
    subjects = (Subject(SubjectKind.APPLICATION, id) for id in ids)
    keys = {key for subject in subjects for key in keys_of(world, subject)}
    for name, service in world.config.definitions.items():
        key = ServiceKey(name, node, for_cluster=True)
        if node in service.nodes.values() and is_needed(world, key):
            keys.add(key)
    return sum(isinstance(key, ServiceKey) and key.node == node for key in keys)


def _exceeded(domain: AccessDomain, quota: str, most: int, usage: str) -> Fault:
    return fault(
        "",
        f"{usage}, but quotas.{quota} of access domain '{domain.name}' allows {most}; release "
        "something first, or ask for a change of policy/",
        code="quota",
    )
