"""Trial demands: the releases of every appdef, and of every override that applies to it.

They show mistakes in a configuration before a real demand arrives. Nothing is rendered here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import datetime, timezone

from demandops.config.appdef import ApplicationDefinition
from demandops.config.config import Config
from demandops.config.override import Override
from demandops.config.policy import matches
from demandops.demand.application import Application, InputTopic
from demandops.demand.demand_request import Demanded, Join, Place
from demandops.ledger.apply import apply
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World
from demandops.plan.overrides.release_overrides import apply_effects, effects_on
from demandops.plan.planner import plan
from demandops.plan.release import ServiceRelease
from demandops.plan.release_keys import affected_keys

_NEVER = datetime.fromtimestamp(0, timezone.utc)


def trial_releases(config: Config) -> dict[str, list[ServiceRelease]]:
    """Return appdef → its services for a trial demand on the first node, without overrides.

    Raises:
        Refused: if one cannot be planned.
    """
    node = next(iter(sorted(config.domain_of)), None)
    if node is None:
        return {}
    plain = config.without_overrides()
    return {appdef.name: list(_services(appdef, node, plain)) for appdef in config.appdefs.values()}


def _services(appdef: ApplicationDefinition, node: str, config: Config) -> Iterator[ServiceRelease]:
    inputs = {
        role: (InputTopic(f"/rehearsal/{role.replace('-', '_')}", node),) for role in appdef.inputs
    }
    app = Application(f"rehearsal/{appdef.name}", appdef.name, node, inputs)
    request = Join("rehearsal", (Demanded(app, ("rehearsal",), Place("")),))
    ledger, changes = apply(Ledger(), request, _NEVER)
    before, after = World(config, Ledger()), World(config, ledger)
    for key in affected_keys(before, after, changes.claims):
        release = plan(after, key)
        if isinstance(release, ServiceRelease):
            yield release


def overridden_releases(
    override: Override, trials: Iterable[ServiceRelease], appdef: str, config: Config
) -> Iterator[ServiceRelease]:
    """Yield the trial releases of an appdef that an override may select, with its effects."""
    for release in trials:
        effects = tuple(e for e in effects_on(release, override, config) if e != "hold")
        if effects and any(
            not selector.connections
            and (not selector.services or matches(release.key.service, selector.services))
            and (not selector.appdefs or matches(appdef, selector.appdefs))
            for selector in override.select
        ):
            shaped = apply_effects(release, [(override, effects)], config)
            if isinstance(shaped, ServiceRelease):
                yield shaped
