"""``deny``: a demand that an override rules out is refused, and told why and by whom.

Who asks again for what stands already only renews it, which is always allowed; it is then told
that it is suspended.
"""

from __future__ import annotations

from collections.abc import Iterator

from demandops.config.config import Config
from demandops.config.override import Override, Selector, format_time
from demandops.config.policy import matches
from demandops.demand.claim import Subject, SubjectKind
from demandops.demand.demand_request import ApplicationDemand, ConnectionDemand, DemandRequest
from demandops.errors import Fault, fault
from demandops.ledger.apply import Changes, Ledger
from demandops.plan.overrides.claims_in_force import suspended_by
from demandops.plan.overrides.selectors import Traits, fits, labelled, traits_of
from demandops.plan.release import ServiceKey
from demandops.plan.release_keys import keys_booked


def faults(
    request: DemandRequest, after: Ledger, changes: Changes, config: Config
) -> Iterator[Fault]:
    """Yield each thing that a request asks anew and an override denies."""
    denying = [one for one in reversed(config.active_overrides) if one.deny]
    if not denying or not request.operation.adds_claims:
        return
    renewed = {
        change.key.subject: change.before is not None
        and change.after is not None
        and change.before.booked == change.after.booked
        for change in changes.claims
    }
    for subject, where, asked in _listed(request):
        if renewed.get(subject, True):
            continue
        for override in denying:
            field = _denied(
                override, where, asked, list(_runs(asked, subject, after, config)), config
            )
            if field:
                yield fault(field, _told(override), code="denied")
                break


def _listed(
    request: DemandRequest,
) -> Iterator[tuple[Subject, str, ApplicationDemand | ConnectionDemand]]:
    for index, app in enumerate(request.applications):
        yield Subject(SubjectKind.APPLICATION, app.id), f"applications[{index}]", app
    for index, one in enumerate(request.connections):
        yield Subject(SubjectKind.CONNECTION, one.id), f"connections[{index}]", one


def _runs(
    asked: ApplicationDemand | ConnectionDemand, subject: Subject, after: Ledger, config: Config
) -> Iterator[Traits]:
    """Yield the services that an application would run, as selectors see them."""
    if not isinstance(asked, ApplicationDemand):
        return
    for key in keys_booked(after, config, subject):
        if isinstance(key, ServiceKey):
            yield Traits(
                (key.node,), asked.requesters, (asked.id,), (asked.appdef,), service=key.service
            )


def _denied(
    override: Override,
    where: str,
    asked: ApplicationDemand | ConnectionDemand,
    services: list[Traits],
    config: Config,
) -> str:
    """Return the field for which an override denies what is asked, or nothing."""
    for selector in override.select:
        looked_at = services if selector.services else [traits_of(asked)]
        for traits in looked_at:
            if fits(selector, traits, config):
                return f"{where}.{_field(selector, asked, config)}"
    return ""


def _field(selector: Selector, asked: ApplicationDemand | ConnectionDemand, config: Config) -> str:
    """Return the field of what is asked that a selector goes by, the most telling one."""
    if selector.applications or selector.connections:
        return "id"
    if selector.requesters:
        who = selector.requesters
        index = next(i for i, name in enumerate(asked.requesters) if matches(name, who))
        return f"requesters[{index}]"
    if selector.services or selector.appdefs:
        return "appdef"
    if isinstance(asked, ApplicationDemand):
        return "node"
    at_source = not selector.nodes or matches(asked.source, selector.nodes)
    return "source" if at_source and labelled(selector, asked.source, config) else "target"


def _told(override: Override) -> str:
    until = f" until {format_time(override.end)}" if override.end else ""
    return (
        f"is denied by {override.path}{until}: {override.reason}; ask its owner, {override.owner}, "
        "or leave it out"
    )


def warnings(request: DemandRequest, ledger: Ledger, config: Config) -> Iterator[str]:
    """Yield what of a demand is booked and does not run, for an override suspends it."""
    subjects = dict.fromkeys(subject for subject, _, _ in _listed(request))
    claims = [
        *ledger.of_demand(request.demand),
        *(claim for subject in subjects for claim in ledger.of(subject)),
    ]
    seen = set()
    asking = set(request.requesters())
    for claim in claims if config.active_overrides else ():
        override = suspended_by(claim, config)
        if override is None or claim.key in seen or not asking & set(claim.requesters):
            continue
        seen.add(claim.key)
        by = f"{override.path} of {override.owner}: {override.reason}"
        yield f"{claim.subject} is suspended by {by}"
