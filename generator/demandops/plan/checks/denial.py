"""``deny``: a demand that an override denies is refused, with the reason and the owner.

A demand that only repeats existing claims renews them. That is always allowed; it gets a warning
that they are suspended.
"""

from __future__ import annotations

from collections.abc import Iterator

from demandops.config.config import Config
from demandops.config.override import Override, Selector, format_time
from demandops.config.policy import matches
from demandops.demand.claim import Subject, SubjectKind
from demandops.demand.demand_request import ApplicationDemand, ConnectionDemand, DemandRequest
from demandops.errors import Fault, fault
from demandops.ledger.ledger import Changes, Ledger
from demandops.plan.overrides.selectors import Traits, fits, has_labels, traits_of
from demandops.plan.overrides.suspended_claims import suspended_by
from demandops.plan.release import ServiceKey
from demandops.plan.release_keys import keys_of_claims


def faults(
    request: DemandRequest, after: Ledger, changes: Changes, config: Config
) -> Iterator[Fault]:
    """Yield every new application and connection of a request that an override denies."""
    denying = [one for one in reversed(config.active_overrides) if one.deny]
    if not denying or not request.operation.adds_claims:
        return
    renewed = {
        change.key.subject: change.before is not None
        and change.after is not None
        and change.before.booked == change.after.booked
        for change in changes.claims
    }
    for subject, where, demanded in _listed(request):
        if renewed.get(subject, True):
            continue
        for override in denying:
            field = _denied_field(
                override,
                where,
                demanded,
                list(_service_traits(demanded, subject, after, config)),
                config,
            )
            if field:
                yield fault(field, _message(override), code="denied")
                break


def _listed(
    request: DemandRequest,
) -> Iterator[tuple[Subject, str, ApplicationDemand | ConnectionDemand]]:
    for index, app in enumerate(request.applications):
        yield Subject(SubjectKind.APPLICATION, app.id), f"applications[{index}]", app
    for index, connection in enumerate(request.connections):
        subject = Subject(SubjectKind.CONNECTION, connection.id)
        yield subject, f"connections[{index}]", connection


def _service_traits(
    demanded: ApplicationDemand | ConnectionDemand, subject: Subject, after: Ledger, config: Config
) -> Iterator[Traits]:
    """Yield the traits of the services that an application needs."""
    if not isinstance(demanded, ApplicationDemand):
        return
    for key in keys_of_claims(after, config, after.claims_on(subject)):
        if isinstance(key, ServiceKey):
            yield Traits(
                (key.node,),
                demanded.requesters,
                (demanded.id,),
                (demanded.appdef,),
                service=key.service,
            )


def _denied_field(
    override: Override,
    where: str,
    demanded: ApplicationDemand | ConnectionDemand,
    services: list[Traits],
    config: Config,
) -> str:
    """Return the field that makes an override deny a demanded subject, or an empty text."""
    for selector in override.select:
        for traits in services if selector.services else [traits_of(demanded)]:
            if fits(selector, traits, config):
                return f"{where}.{_matched_field(selector, demanded, config)}"
    return ""


def _matched_field(
    selector: Selector, demanded: ApplicationDemand | ConnectionDemand, config: Config
) -> str:
    """Return the field that a selector matches; of several, the most specific one."""
    if selector.applications or selector.connections:
        return "id"
    if selector.requesters:
        who = selector.requesters
        index = next(i for i, name in enumerate(demanded.requesters) if matches(name, who))
        return f"requesters[{index}]"
    if selector.services or selector.appdefs:
        return "appdef"
    if isinstance(demanded, ApplicationDemand):
        return "node"
    at_source = not selector.nodes or matches(demanded.source, selector.nodes)
    return "source" if at_source and has_labels(selector, demanded.source, config) else "target"


def _message(override: Override) -> str:
    until = f" until {format_time(override.end)}" if override.end else ""
    return (
        f"is denied by {override.path}{until}: {override.reason}; ask its owner, {override.owner}, "
        "or leave it out"
    )


def warnings(request: DemandRequest, ledger: Ledger, config: Config) -> Iterator[str]:
    """Yield a warning for each claim of a demand that an override suspends."""
    if not any(override.deny for override in config.active_overrides):
        return
    subjects = dict.fromkeys(subject for subject, _, _ in _listed(request))
    claims = [
        *ledger.claims_of_demand(request.demand),
        *(claim for subject in subjects for claim in ledger.claims_on(subject)),
    ]
    seen = set()
    requesters = set(request.requesters())
    for claim in claims:
        override = suspended_by(claim, config)
        if override is None or claim.key in seen or not requesters & set(claim.requesters):
            continue
        seen.add(claim.key)
        by = f"{override.path} of {override.owner}: {override.reason}"
        yield f"{claim.subject} is suspended by {by}"
