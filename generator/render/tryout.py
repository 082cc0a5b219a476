"""A rehearsal: what people merge is rendered for invented demands before a real one comes."""

from __future__ import annotations

from collections.abc import Iterable

from generator.catalog.catalog import Catalog
from generator.errors import Fault, InvalidInput
from generator.plan import rehearsal
from generator.plan.release import ServiceRelease
from generator.render import gitops
from generator.render.engine import Engine


def rehearse(catalog: Catalog, engine: Engine) -> None:
    """Render every service of every appdef once, for invented claims on a real node.

    An appdef that nobody has demanded yet is checked before the first demand comes, and so is what
    each override in force would make of it.

    Raises:
        Refused, InvalidInput: naming the template, the values or the override that does not work.
    """
    invented = rehearsal.releases(catalog)
    faults = [found for made in invented.values() for found in _tried(made, catalog, engine)]
    for override in () if faults else catalog.in_force:
        tries = {
            appdef: list(rehearsal.overridden(override, made, appdef, catalog))
            for appdef, made in invented.items()
        }
        failed = [_tried(made, catalog, engine) for made in tries.values() if made]
        if all(failed):  # else there is an application that it may be meant for
            faults += [found for one in failed[:1] for found in one]
    if faults:
        raise InvalidInput(dict.fromkeys(faults))


def _tried(releases: Iterable[ServiceRelease], catalog: Catalog, engine: Engine) -> list[Fault]:
    faults: list[Fault] = []
    for release in releases:
        try:
            gitops.render(release, catalog, engine)
        except InvalidInput as error:
            faults += error.faults
    return faults
