"""What a decision starts from, the world at one commit, and all that is rendered of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from types import MappingProxyType

from rpds import HashTrieMap

from demandops.base.errors import InvalidInput, OverLimit, Refused
from demandops.decide import changeset
from demandops.decide.booking import apply
from demandops.decide.checks import collisions
from demandops.decide.checks.collisions import Names
from demandops.decide.placement import capacity
from demandops.decide.placement.capacity import Usage
from demandops.decide.planning.overrides import apply_effects, effects_on
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import ReleaseKey, affected_keys, all_keys
from demandops.model.config.appdef import ApplicationDefinition
from demandops.model.config.config import Config
from demandops.model.demand.demand import Application, Demand, InputTopic, Item
from demandops.model.ledger.ledger import ClaimChange, Ledger, World
from demandops.model.release import Release, ServiceRelease
from demandops.render import gitops
from demandops.templating.values import Evaluate


@dataclass(frozen=True, slots=True)
class State(World):
    evaluate: Evaluate
    # The releases that earlier decisions on this configuration planned, so that a decision need not
    # plan them again to tell what it changes. A copy made with ``replace`` has none; followed_by
    # carries over those that are still valid.
    plans: HashTrieMap[ReleaseKey, Release] = field(
        default_factory=HashTrieMap, init=False, compare=False, repr=False
    )
    _usage: Usage | None = field(default=None, init=False, compare=False, repr=False)
    _names: Names | None = field(default=None, init=False, compare=False, repr=False)

    def usage(self) -> Usage:
        """Return how much the services request; the first call counts all services."""
        usage = capacity.whole_usage(self) if self._usage is None else self._usage
        object.__setattr__(self, "_usage", usage)
        return usage

    def names(self) -> Names:
        """Return the names of all releases; only the first call looks at all releases."""
        names = collisions.all_names(self) if self._names is None else self._names
        object.__setattr__(self, "_names", names)
        return names

    def followed_by(
        self, ledger: Ledger, planned: changeset.PlannedChange, usage: Usage, names: Names
    ) -> State:
        plans = self.plans
        for key, release in planned.plans.items():
            plans = plans.insert(key, release) if release else plans.discard(key)
        state = replace(self, ledger=ledger)
        object.__setattr__(state, "plans", plans)
        object.__setattr__(state, "_usage", usage)
        object.__setattr__(state, "_names", names)
        return state

    def with_ledger(self, ledger: Ledger, changes: Iterable[ClaimChange]) -> State:
        state, changes = replace(self, ledger=ledger), tuple(changes)
        # If a definition is gone, ``names`` and ``usage`` look at all releases again.
        with suppress(Refused):
            if self._names is not None:
                keys = affected_keys(self, state, changes)
                names = collisions.followed(self._names, self, state, keys)
                object.__setattr__(state, "_names", names)
        with suppress(Refused):
            if self._usage is not None:
                usage = self._usage.plus(capacity.growth_by(self, state, changes))
                object.__setattr__(state, "_usage", usage)
        return state


# ---- all generated files of a state ----


def rendered_files(
    state: State, current: Mapping[str, str] = MappingProxyType({}), *, keeps_late: bool = False
) -> dict[str, str]:
    """Return all generated files except those of the ledger, by path.

    A ``hold`` override keeps files of ``current``. With ``keeps_late``, so does a release whose
    values take too long to compute.
    """
    config, keys = state.config, all_keys(state)
    files = gitops.base_files(config)
    collisions.refuse_shared_names(state, keys)  # one would overwrite the file of the other
    for key in keys:
        if (release := plan(state, key)) is None:
            continue
        path = gitops.path_of(release)
        try:
            files[path] = gitops.release_text(release, config, state.evaluate, current.get(path))
        except OverLimit:
            if not keeps_late:
                raise
            if path in current:
                files[path] = current[path]
    return files | gitops.kept_charts(files, current, state)


# ---- trial demands: a new configuration must render before real demands arrive ----

_NEVER = datetime.fromtimestamp(0, timezone.utc)


def trial_releases(config: Config) -> dict[str, list[ServiceRelease]]:
    if not config.domain_of and not [*config.example_nodes()]:
        return {}
    plain = replace(config, overrides={})
    return {name: list(_trial_services(appdef, plain)) for name, appdef in config.appdefs.items()}


def _trial_services(
    appdef: ApplicationDefinition, config: Config, version: str = ""
) -> Iterator[ServiceRelease]:
    services = config.services.get(appdef.name, {}).values()
    nodes = [*sorted(config.domain_of), *config.example_nodes()]
    # A service that runs once for a cluster has no node in other clusters. So this is the first
    # node that can run all services, else the first of all.
    fitting = (node for node in nodes if all(node in s.runs_at for s in services if s.nodes))
    node = next(fitting, nodes[0])
    inputs = {
        role: (InputTopic(f"/rehearsal/{role.replace('-', '_')}", node),) for role in appdef.inputs
    }
    app = Application(f"rehearsal/{appdef.name}", appdef.name, node, inputs, version=version)
    request = Demand("join", "rehearsal", (Item(app, ("rehearsal",)),))
    ledger, changes = apply(Ledger(), request, _NEVER)
    before, after = World(config, Ledger()), World(config, ledger)
    for key in affected_keys(before, after, changes.claims):
        release = plan(after, key)
        if isinstance(release, ServiceRelease):
            yield release


def try_configuration(state: State) -> None:
    """Render every service of every appdef, with invented claims on a real node.

    This renders each version that ``registry/versions.yaml`` lists, and each override in effect. If
    no node is in an access domain, nothing is checked.

    Raises:
        Refused, InvalidInput: if a service cannot be planned or rendered. The error names the
            template, the schema or the override at fault.
        OverLimit: if nothing is known to be wrong, but some of it took too long to render.
    """
    config = state.config
    plain = replace(config, overrides={})

    def errors_of(releases: Iterable[Release]) -> Iterator[InvalidInput]:
        for release in releases:
            try:
                gitops.render(release, config, state.evaluate)
            except InvalidInput as error:
                yield error

    trials = trial_releases(config)
    errors = [error for releases in trials.values() for error in errors_of(releases)]
    for appdef, listed in config.versions.items() if trials else ():
        for version in listed.versions:
            if version != listed.default:
                errors += errors_of(_trial_services(config.appdefs[appdef], plain, version))
    # only if all can be rendered without overrides: else a broken template would blame them
    for override in () if errors else state.overrides:
        failed = []
        for appdef, releases in trials.items():
            overridden = [
                apply_effects(release, [(override, effects)], config)
                for release in releases
                if (effects := effects_on(release, override, config))
                and any(
                    not selector.connections and selector.takes(release.key.service, appdef)
                    for selector in override.select
                )
            ]
            if overridden:
                failed.append([*errors_of(overridden)])
        # an override that can be rendered for one of the appdefs may be meant for that one only
        if failed and all(failed):
            errors += failed[0]
    if errors:
        only_late = all(isinstance(error, OverLimit) for error in errors)
        faults = dict.fromkeys(fault for error in errors for fault in error.faults)
        raise (OverLimit if only_late else InvalidInput)(faults)
