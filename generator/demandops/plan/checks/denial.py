"""Denials: a demand is refused if an override with ``deny`` selects what the demand asks for.

The fault names the reason and the owner of the override. A demand that only repeats existing claims
is never denied. If an override suspends these claims, the requester gets a warning.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.config.override import Override, Selector, format_time
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
    """Yield a fault for each demanded application or connection that an override denies.

    There is no fault if the demand changes at most the lease of its claim on the application or
    connection.
    """
    denying = [one for one in reversed(after.overrides) if one.deny]
    if not denying or not request.adds_claims:
        return
    renewed = {change.key.subject: change.only_renews for change in changes.claims}
    for one in request.demanded:
        if renewed.get(one.held.subject, True):
            continue
        services = list(_service_traits(one, after))
        for override in denying:
            field = _denied_field(override, one, services, after.config)
            if field:
                yield one.fault(field, _message(override), code="denied")
                break


def _service_traits(one: Demanded, after: World) -> Iterator[Traits]:
    if not isinstance(one.held, Application):
        return
    app = traits_of(one)
    for key in keys_of_claims(after, after.ledger.claims_on(one.held.subject)):
        if isinstance(key, ServiceKey):
            yield replace(app, nodes=(key.node,), service=key.service)


def _denied_field(override: Override, one: Demanded, services: list[Traits], config: Config) -> str:
    """Return the field because of which an override denies a demanded item, or an empty text."""
    for selector in override.select:
        for traits in services if selector.services else [traits_of(one)]:
            if fits(selector, traits, config):
                return _matched_field(selector, one, config)
    return ""


def _matched_field(selector: Selector, one: Demanded, config: Config) -> str:
    """Return the most specific field of a demanded item that a selector matches."""
    if selector.applications or selector.connections:
        return "id"
    if selector.requesters:
        who = selector.requesters
        index = next(i for i, name in enumerate(one.requesters) if matches(name, who))
        return f"requesters[{index}]"
    if selector.services or selector.appdefs:
        return "appdef"
    if isinstance(one.held, Application):
        return "node"
    source = one.held.source
    at_source = not selector.nodes or matches(source, selector.nodes)
    return "source" if at_source and has_labels(selector, source, config) else "target"


def _message(override: Override) -> str:
    until = f" until {format_time(override.end)}" if override.end else ""
    return (
        f"is denied by {override.path}{until}: {override.reason}; ask the override's owner, "
        f"{override.owner}, or demand something else"
    )


def warnings(request: DemandRequest, world: World) -> Iterator[str]:
    """Yield a warning for each suspended claim that concerns a demand.

    A claim concerns a demand if the demand holds the claim or lists the claim's application or
    connection. A claim that has no requester of the demand never concerns the demand.
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
