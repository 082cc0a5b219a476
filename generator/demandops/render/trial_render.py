"""A rehearsal: what people merge is rendered for invented demands before a real one comes."""

from __future__ import annotations

from collections.abc import Iterable

from demandops.config.config import Config
from demandops.errors import Fault, InvalidInput
from demandops.plan.checks import trial_demands
from demandops.plan.release import ServiceRelease
from demandops.render.engine import Engine
from demandops.render.gitops import controller


def rehearse(config: Config, engine: Engine) -> None:
    """Render every service of every appdef once, for invented claims on a real node.

    An appdef that nobody has demanded yet is checked before the first demand comes, and so is what
    each override in force would make of it.

    Raises:
        Refused, InvalidInput: naming the template, the values or the override that does not work.
    """
    invented = trial_demands.releases(config)
    faults = [found for made in invented.values() for found in _tried(made, config, engine)]
    for override in () if faults else config.active_overrides:
        tries = {
            appdef: list(trial_demands.overridden(override, made, appdef, config))
            for appdef, made in invented.items()
        }
        failed = [_tried(made, config, engine) for made in tries.values() if made]
        if all(failed):  # else there is an application that it may be meant for
            faults += [found for one in failed[:1] for found in one]
    if faults:
        raise InvalidInput(dict.fromkeys(faults))


def _tried(releases: Iterable[ServiceRelease], config: Config, engine: Engine) -> list[Fault]:
    faults: list[Fault] = []
    for release in releases:
        try:
            controller.render(release, config, engine)
        except InvalidInput as error:
            faults += error.faults
    return faults
