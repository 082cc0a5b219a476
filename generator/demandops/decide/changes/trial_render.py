"""Checks a new configuration by rendering invented demands, before real demands arrive."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import datetime, timezone

from demandops.base.errors import InvalidInput, OverLimit
from demandops.decide.booking.apply import apply
from demandops.decide.planning.overrides import apply_effects, effects_on
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import affected_keys
from demandops.model.config.appdef import ApplicationDefinition
from demandops.model.config.config import Config
from demandops.model.config.override import Override
from demandops.model.demand.application import Application, InputTopic
from demandops.model.demand.demand_request import Demanded, Join
from demandops.model.ledger.ledger import Ledger, World
from demandops.model.release import ServiceRelease
from demandops.render import manifests
from demandops.templating.values import Evaluate

_NEVER = datetime.fromtimestamp(0, timezone.utc)


def trial_releases(config: Config) -> dict[str, list[ServiceRelease]]:
    """Return the services' releases that a trial demand gives, for each appdef.

    Overrides do not apply. If no node is in an access domain, the map is empty.
    """
    if not config.domain_of:
        return {}
    plain = replace(config, overrides={})
    return {
        name: list(_services(appdef, _trial_node(name, config), plain))
        for name, appdef in config.appdefs.items()
    }


def _trial_node(appdef: str, config: Config) -> str:
    """Return the first node that can run all services of an appdef, else the first of all."""
    services = config.services.get(appdef, {}).values()
    nodes = sorted(config.domain_of)
    # a service that runs once for a cluster has no node in other clusters
    fitting = (node for node in nodes if all(node in s.runs_at for s in services if s.nodes))
    return next(fitting, nodes[0])


def _services(
    appdef: ApplicationDefinition, node: str, config: Config, version: str = ""
) -> Iterator[ServiceRelease]:
    inputs = {
        role: (InputTopic(f"/rehearsal/{role.replace('-', '_')}", node),) for role in appdef.inputs
    }
    app = Application(f"rehearsal/{appdef.name}", appdef.name, node, inputs, version=version)
    request = Join("rehearsal", (Demanded(app, ("rehearsal",), str),))
    ledger, changes = apply(Ledger(), request, _NEVER)
    before, after = World(config, Ledger()), World(config, ledger)
    for key in affected_keys(before, after, changes.claims):
        release = plan(after, key)
        if isinstance(release, ServiceRelease):
            yield release


def overridden_releases(
    override: Override, trials: Iterable[ServiceRelease], appdef: str, config: Config
) -> Iterator[ServiceRelease]:
    """Yield the trial releases that an override may select, changed by the override."""
    for release in trials:
        # ``hold`` would keep a file that no trial has
        effects = tuple(e for e in effects_on(release, override, config) if e != "hold")
        if effects and any(
            not selector.connections and selector.takes(release.key.service, appdef)
            for selector in override.select
        ):
            shaped = apply_effects(release, [(override, effects)], config)
            if isinstance(shaped, ServiceRelease):
                yield shaped


def render_trial_demands(world: World, evaluate: Evaluate) -> None:
    """Render every service of every appdef, with invented claims on a real node.

    A service is rendered for each version that ``registry/versions.yaml`` lists, and with each
    override that is in effect. If no node is in an access domain, nothing is checked.

    Raises:
        Refused, InvalidInput: if a service cannot be planned or rendered. The error names the
            template, the schema or the override at fault.
        OverLimit: if nothing is known to be wrong, but some of it took too long to render.
    """
    config = world.config
    trials = trial_releases(config)
    plain = replace(config, overrides={})
    others = (
        release
        for appdef, listed in (config.versions.items() if trials else ())
        for version in listed.versions
        if version != listed.default
        for release in _services(
            config.appdefs[appdef], _trial_node(appdef, config), plain, version
        )
    )
    errors = [
        error
        for releases in (*trials.values(), others)
        for error in _render_errors(releases, config, evaluate)
    ]
    # only if all can be rendered without overrides: else a broken template would blame them
    for override in () if errors else world.overrides:
        overridden = [
            list(overridden_releases(override, releases, appdef, config))
            for appdef, releases in trials.items()
        ]
        failed = [_render_errors(releases, config, evaluate) for releases in overridden if releases]
        # an override that can be rendered for one of the appdefs may be meant for that one only
        if failed and all(failed):
            errors += failed[0]
    if errors:
        only_late = all(isinstance(error, OverLimit) for error in errors)
        faults = dict.fromkeys(fault for error in errors for fault in error.faults)
        raise (OverLimit if only_late else InvalidInput)(faults)


def _render_errors(
    releases: Iterable[ServiceRelease], config: Config, evaluate: Evaluate
) -> list[InvalidInput]:
    errors: list[InvalidInput] = []
    late = set[str]()  # a template that takes too long is tried only once
    for release in releases:
        if config.values_template(release.service) in late:
            continue
        try:
            manifests.render(release, config, evaluate)
        except InvalidInput as error:
            errors.append(error)
            if isinstance(error, OverLimit):
                late.add(config.values_template(release.service))
    return errors
