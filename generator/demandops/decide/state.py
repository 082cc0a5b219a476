"""What a decision about a demand starts from: the world at one commit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from rpds import HashTrieMap

from demandops.base.errors import Refused
from demandops.decide import changeset
from demandops.decide.checks import collisions
from demandops.decide.checks.collisions import Names
from demandops.decide.placement import capacity
from demandops.decide.placement.capacity import Usage
from demandops.decide.planning.release_keys import ReleaseKey, affected_keys
from demandops.model.ledger.ledger import ClaimChange, Ledger, World
from demandops.model.release import Release
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

    def followed_by(self, ledger: Ledger, planned: changeset.PlannedChange, usage: Usage) -> State:
        plans = self.plans
        for key, release in planned.plans.items():
            plans = plans.insert(key, release) if release else plans.discard(key)
        state = replace(self, ledger=ledger)
        object.__setattr__(state, "plans", plans)
        object.__setattr__(state, "_usage", usage)
        if self._names is not None:
            names = collisions.followed(self._names, self, state, planned.plans.keys())
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


def rendered_files(
    state: State, current: Mapping[str, str] = MappingProxyType({}), *, keeps_late: bool = False
) -> dict[str, str]:
    # ``hold`` overrides and ``keeps_late`` may keep files of ``current``.
    return changeset.render_all(state, state.evaluate, current, keeps_late=keeps_late)


def try_configuration(state: State) -> None:
    changeset.render_trial_demands(state, state.evaluate)
