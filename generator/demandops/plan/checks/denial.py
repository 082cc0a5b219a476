"""Denials: a demand is refused if an override with ``deny`` selects what the demand asks for.

A demand that only repeats existing claims is never denied. If an override suspends these claims,
the requester gets a warning.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

from demandops.config.config import Config
from demandops.config.override import Selector, format_time
from demandops.config.policy import matches
from demandops.demand.application import Application
from demandops.demand.demand_request import Demanded, DemandRequest
from demandops.errors import Fault
from demandops.ledger.claim_changes import Changes
from demandops.ledger.world import World
from demandops.plan.overrides.claim_overrides import (
    Traits,
    fits,
    has_labels,
    suspended_by,
    traits_of,
)
from demandops.plan.release import ServiceKey
from demandops.plan.release_keys import keys_of_claims


def faults(request: DemandRequest, after: World, changes: Changes) -> Iterator[Fault]:
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
        demanded, services = traits_of(item), list[Traits]()
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
            message = (
                f"is denied by {override.path}{until}: {override.reason}; ask the override's "
                f"owner, {override.owner}, or demand something else"
            )
            yield item.fault(_matched_field(selector, item, after.config), message, code="denied")


def _matched_field(selector: Selector, item: Demanded, config: Config) -> str:
    """Return the most specific field of a demanded item that a selector matches."""
    if selector.applications or selector.connections:
        return "id"
    if selector.requesters:
        patterns = selector.requesters
        index = next(i for i, name in enumerate(item.requesters) if matches(name, patterns))
        return f"requesters[{index}]"
    if selector.services or selector.appdefs:
        return "appdef"
    if isinstance(item.held, Application):
        return "node"
    source = item.held.source
    at_source = not selector.nodes or matches(source, selector.nodes)
    return "source" if at_source and has_labels(selector, source, config) else "target"


def warnings(request: DemandRequest, world: World) -> Iterator[str]:
    """Yield a warning for each suspended claim that a demand holds or lists.

    A claim that has no requester of the demand is left out.
    """
    if not any(override.deny for override in world.overrides):
        return
    claims = [
        *world.ledger.claims_of_demand(request.demand),
        *(claim for subject in request.subjects() for claim in world.ledger.claims_on(subject)),
    ]
    seen = set()
    requesters = set(request.requesters())
    for claim in claims:
        override = suspended_by(claim, world)
        if override is None or claim.key in seen or not requesters & set(claim.requesters):
            continue
        seen.add(claim.key)
        by = f"{override.path} of {override.owner}: {override.reason}"
        yield f"{claim.subject} is suspended by {by}"
