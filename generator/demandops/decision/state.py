"""What a decision about a demand starts from: the world at one commit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from rpds import HashTrieMap

from demandops.errors import Refused
from demandops.ledger.claim_changes import ClaimChange
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World
from demandops.plan.nodes import capacity
from demandops.plan.nodes.capacity import Usage
from demandops.plan.release import Release
from demandops.plan.release_keys import ReleaseKey, all_keys
from demandops.render import trial_render
from demandops.render.changes import changeset
from demandops.templating.values import Evaluate


@dataclass(frozen=True, slots=True)
class State(World):
    """The world at one commit, and what computes the values of services in it.

    ``plans`` are releases that earlier decisions on this configuration planned. A copy made with
    ``replace`` has no plans; only :meth:`followed_by` carries over those that are still valid.
    """

    evaluate: Evaluate
    plans: HashTrieMap[ReleaseKey, Release] = field(
        default_factory=HashTrieMap, init=False, compare=False, repr=False
    )
    _usage: Usage | None = field(default=None, init=False, compare=False, repr=False)

    def usage(self) -> Usage:
        """Return, for each node and resource, how much the services request.

        Only the first call counts all services; later calls return the same result.
        """
        if self._usage is None:
            object.__setattr__(self, "_usage", capacity.whole_usage(self))
        assert self._usage is not None  # noqa: S101 - set above
        return self._usage

    def followed_by(self, ledger: Ledger, rendered: changeset.Changeset, usage: Usage) -> State:
        """Return the state after a decision, with the releases that the decision planned.

        ``usage`` is the total that services request on each node after the decision.
        """
        known = self.plans
        for key, release in rendered.plans.items():
            known = known.insert(key, release) if release else known.discard(key)
        state = replace(self, ledger=ledger)
        object.__setattr__(state, "plans", known)
        object.__setattr__(state, "_usage", usage)
        return state

    def with_ledger(self, ledger: Ledger, changes: Iterable[ClaimChange]) -> State:
        """Return the state with another ledger, whose claims differ by ``changes``.

        If the usage of nodes is known, only the changed claims are counted again.
        """
        state = replace(self, ledger=ledger)
        if self._usage is not None:
            with suppress(Refused):  # if a definition is gone; then ``usage`` counts all services
                usage = self._usage.plus(capacity.growth_by(self, state, changes))
                object.__setattr__(state, "_usage", usage)
        return state


def rendered_files(
    state: State,
    current: Mapping[str, str] = MappingProxyType({}),
    *,
    keeps_late: bool = False,
) -> dict[str, str]:
    """Return every generated file that the state requires, as a map from path to text.

    Args:
        state: the world to render.
        current: the current generated files. An override with ``hold`` keeps some of these files.
        keeps_late: whether a release whose values take too long to compute keeps its file, instead
            of OverLimit.
    """
    keys = all_keys(state)
    return changeset.render_all(state, state.evaluate, keys, current, keeps_late=keeps_late)


def try_configuration(state: State) -> None:
    """Render trial demands, so that every appdef and every override in effect is tried once.

    Raises:
        Refused, InvalidInput: if a template, its values or an override does not work. Each fault
            names what does not work.
    """
    trial_render.render_trial_demands(state, state.evaluate)
