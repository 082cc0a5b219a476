"""Invented demands: what every appdef would run, and every override would make of it.

What people merge is tried before somebody demands it. Gives releases to render; renders nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import datetime, timezone

from generator.catalog.appdef import ApplicationDefinition
from generator.catalog.catalog import Catalog
from generator.catalog.override import Override
from generator.catalog.policy import matches
from generator.demand.request import ApplicationDemand, DemandRequest, InputTopic, Operation
from generator.ledger import ledger as booking
from generator.ledger.ledger import Ledger
from generator.plan.overrides import effects_on, with_overrides
from generator.plan.planner import affected, plan
from generator.plan.release import ServiceRelease

_NEVER = datetime.fromtimestamp(0, timezone.utc)


def releases(catalog: Catalog) -> dict[str, list[ServiceRelease]]:
    """Return appdef → its services for an invented demand on some node, without overrides.

    Raises:
        Refused: where one cannot be planned.
    """
    place = next(iter(sorted(catalog.domain_of)), None)
    if place is None:
        return {}
    plain = catalog.without_overrides()
    return {
        appdef.name: list(_services(appdef, place, plain)) for appdef in catalog.appdefs.values()
    }


def _services(
    appdef: ApplicationDefinition, place: str, catalog: Catalog
) -> Iterator[ServiceRelease]:
    request = DemandRequest(
        id="rehearsal",
        operation=Operation.JOIN,
        applications=(
            ApplicationDemand(
                id=f"rehearsal/{appdef.name}",
                appdef=appdef.name,
                node=place,
                requesters=("rehearsal",),
                inputs={
                    role: (InputTopic(f"/rehearsal/{role.replace('-', '_')}", place),)
                    for role in appdef.inputs
                },
            ),
        ),
    )
    ledger, changes = booking.apply(Ledger(), request, _NEVER)
    for key in affected(Ledger(), ledger, catalog, changes.subjects()):
        release = plan(ledger, catalog, key)
        if isinstance(release, ServiceRelease):
            yield release


def overridden(
    override: Override, invented: Iterable[ServiceRelease], appdef: str, catalog: Catalog
) -> Iterator[ServiceRelease]:
    """Yield the invented releases of an appdef as an override would have those it may be for."""
    for release in invented:
        effects = tuple(e for e in effects_on(release, override, catalog) if e != "hold")
        if effects and any(
            not selector.connections
            and (not selector.services or matches(release.key.service, selector.services))
            and (not selector.appdefs or matches(appdef, selector.appdefs))
            for selector in override.select
        ):
            shaped = with_overrides(release, [(override, effects)], catalog)
            if isinstance(shaped, ServiceRelease):
                yield shaped
