"""A check of new configuration: renders it for invented demands before a real one arrives."""

from __future__ import annotations

from collections.abc import Iterable

from demandops.config.config import Config
from demandops.errors import Fault, InvalidInput
from demandops.ledger.world import World
from demandops.plan.checks import trial_demands
from demandops.plan.release import ServiceRelease
from demandops.render.engine import Engine
from demandops.render.gitops import manifests


def render_trial_demands(world: World, engine: Engine) -> None:
    """Render every service of every appdef once, with invented claims on a real node.

    This checks an appdef before its first demand, without overrides and with each override that is
    in effect. An override fails only if no appdef that it applies to renders with it.

    Raises:
        Refused, InvalidInput: naming the template, the values or the override that does not work.
    """
    config = world.config
    invented = trial_demands.trial_releases(config)
    faults = [
        fault
        for releases in invented.values()
        for fault in _render_faults(releases, config, engine)
    ]
    for override in () if faults else world.overrides:
        overridden = [
            list(trial_demands.overridden_releases(override, releases, appdef, config))
            for appdef, releases in invented.items()
        ]
        failed = [_render_faults(releases, config, engine) for releases in overridden if releases]
        if failed and all(failed):
            faults += failed[0]
    if faults:
        raise InvalidInput(dict.fromkeys(faults))


def _render_faults(
    releases: Iterable[ServiceRelease], config: Config, engine: Engine
) -> list[Fault]:
    faults: list[Fault] = []
    for release in releases:
        try:
            manifests.render(release, config, engine)
        except InvalidInput as error:
            faults += error.faults
    return faults
