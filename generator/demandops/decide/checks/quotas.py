"""Refuses a demand for what people forbid: by overrides that deny, and by quotas."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

from demandops.base.errors import Fault, fault
from demandops.base.naming import Subject, SubjectKind
from demandops.connections.connection import Connection
from demandops.decide.planning import overrides
from demandops.decide.planning.overrides import Traits, fits
from demandops.decide.planning.release_keys import is_needed, keys_of, keys_of_claims
from demandops.model.config.config import Config
from demandops.model.config.override import Selector, format_time
from demandops.model.config.policy import AccessDomain, matches
from demandops.model.demand.demand import Application, Demand, Item
from demandops.model.ledger.ledger import Changes, World
from demandops.model.release import ServiceKey

# ---- denials: a demand is refused if an override with ``deny`` selects what it asks for ----
#
# Such an override suspends existing claims that it selects. A demand that only repeats them is not
# refused; its requester gets a warning.


def denial_faults(request: Demand, after: World, changes: Changes) -> Iterator[Fault]:
    denying = [override for override in reversed(after.overrides) if override.deny]
    if not denying or not request.adds_claims:
        return
    renewed = {change.key.subject: change.only_renews for change in changes.claims}
    for item in request.demanded:
        if renewed.get(item.held.subject, True):
            continue
        # A selector that names services is compared with each service of the application, because
        # a service may run on another node than the application. Any other is compared with the
        # demand.
        demanded, services = overrides.traits_of(item), list[Traits]()
        if isinstance(item.held, Application):
            services = [
                replace(demanded, nodes=(key.node,), service=key.service)
                for key in keys_of_claims(after, after.ledger.claims_on(item.held.subject))
                if isinstance(key, ServiceKey)
            ]
        matching = (
            (override, selector)
            for override in denying
            for selector in override.select
            for traits in (services if selector.services else [demanded])
            if fits(selector, traits, after.config)
        )
        for override, selector in islice(matching, 1):
            until = f" until {format_time(override.end)}" if override.end else ""
            carried = ""
            if isinstance(item.held, Connection) and not item.is_listed:
                route = item.held.topics[0]
                what = f" of connection '{route.listed}'" if route.listed else ""
                topic = item.held.key_of(route).topic
                carried = f"{topic}{what} is carried by connection '{item.held.id}', which "
            message = (
                f"{carried}is denied by {override.path}{until}: {override.reason}; ask the "
                f"override's owner, {override.owner}, or demand something else"
            )
            yield item.fault(_matched_field(selector, item, after.config), message, code="denied")


def _matched_field(selector: Selector, item: Item, config: Config) -> str:
    if selector.applications or selector.connections:
        return "id"
    if selector.requesters:
        patterns = selector.requesters
        index = next(i for i, name in enumerate(item.requesters) if matches(name, patterns))
        return f"requesters[{index}]"
    if selector.services or selector.appdefs:
        return "type"
    if isinstance(item.held, Application):
        return "node"
    source = item.held.source
    at_source = not selector.nodes or matches(source, selector.nodes)
    return "source" if at_source and overrides.has_labels(selector, source, config) else "target"


def warnings(request: Demand, world: World) -> Iterator[str]:
    """Yield a warning for each suspended claim of the requesters that a demand holds or lists."""
    if not any(override.deny for override in world.overrides):
        return
    claims = [
        *world.ledger.claims_of_demand(request.demand),
        *(claim for subject in request.subjects() for claim in world.ledger.claims_on(subject)),
    ]
    seen = set()
    requesters = set(request.requesters())
    for claim in claims:
        override = overrides.suspended_by(claim, world)
        if override is None or claim.key in seen or not requesters & set(claim.requesters):
            continue
        seen.add(claim.key)
        by = f"{override.path} of {override.owner}: {override.reason}"
        yield f"{claim.subject} is suspended by {by}"


# ---- quotas of an access domain: claims for each requester, and services on each node ----
#
# The quota ``demandsPerMinute`` is checked elsewhere (:mod:`.limits`).


def quota_faults(before: World, after: World, changes: Changes) -> Iterator[Fault]:
    """Yield a fault for each quota that the booking exceeds and whose count it raises.

    Suspended claims count for ``claimsPerRequester``. Their services do not run, and so do not
    count for ``servicesPerNode``.
    """
    domain_of = after.config.domain_of
    booked = [change.after for change in changes.claims if change.after]
    holders = {(claim.held.home, who) for claim in booked for who in claim.requesters}
    domains = {
        (domain.name, who): domain for node, who in holders if (domain := domain_of.get(node))
    }
    for (_, requester), domain in sorted(domains.items(), key=lambda pair: pair[0]):
        most = domain.quotas.claims_per_requester
        # The ledger has the count in all domains at hand. If even that fits, no search is needed.
        if most is None or len(after.ledger.keys_with("requester", requester)) <= most:
            continue
        count = _held(requester, after, domain)
        if count > most and count > _held(requester, before, domain):
            usage = f"'{requester}' would hold {count} claims"
            yield _exceeded(domain, "claimsPerRequester", most, usage)
    touched = [claim for change in changes.claims if (claim := change.after or change.before)]
    apps = [claim.application for claim in touched if claim.is_on_application]
    nodes = {node for app in apps for node in app.needed_nodes()}
    # A service that runs once for each cluster runs at the node that its definition names.
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
    world = overrides.without_suspended(world)
    ids = world.ledger.ids_with("node", node)
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
