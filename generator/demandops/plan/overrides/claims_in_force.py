"""The claims in force: the books without those that an override's ``deny`` suspends.

A suspended claim stays booked and is planned as if it were not there. What is planned asks this
view, which judges just the claims that it comes across; there is no second ledger to keep up.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from demandops.config.config import Config
from demandops.config.override import Override
from demandops.demand.claim import Claim, Subject
from demandops.ledger.apply import Ledger
from demandops.plan.overrides.selectors import Traits, fits, traits_of

_MOST_JUDGED = 100_000
"""Claims that are remembered as judged: a shared service has each of its claims looked at often."""


@dataclass(frozen=True, slots=True)
class ClaimsInForce(Ledger):
    """A ledger that does not show suspended claims. For reading only."""

    config: Config | None = field(default=None, compare=False)

    def of(self, subject: Subject) -> tuple[Claim, ...]:
        """Return the claims on ``subject`` that are in force, sorted by demand id."""
        return tuple(claim for claim in Ledger.of(self, subject) if self._stands(claim))

    def carries(self, target: str, topic: str) -> bool:
        """Tell whether some connection in force brings ``topic`` to the node ``target``."""
        return bool(self.bringing(target, topic))

    def _ids(self, *entry: str) -> tuple[str, ...]:
        found = ((key, self.get(key)) for key in self.index.get(entry) or ())
        return tuple(
            sorted({key.subject.id for key, claim in found if claim and self._stands(claim)})
        )

    def _stands(self, claim: Claim) -> bool:
        return self.config is None or suspended_by(claim, self.config) is None


def in_force(ledger: Ledger, config: Config) -> Ledger:
    """Return what of the books is planned; the ledger itself where nothing denies a claim."""
    if isinstance(ledger, ClaimsInForce) or not any(one.deny for one in config.active_overrides):
        return ledger
    return ClaimsInForce(ledger.claims, ledger.index, ledger.minutes, config)


def suspended_by(claim: Claim, config: Config) -> Override | None:
    """Return the override that suspends a claim, the highest where several do, or nothing."""
    if not config.active_overrides:
        return None
    traits = traits_of(claim)
    try:
        return config.denial_cache[traits]
    except KeyError:
        pass
    if len(config.denial_cache) >= _MOST_JUDGED:
        config.denial_cache.clear()
    found = config.denial_cache[traits] = denied_by(traits, config)
    return found


def denied_by(traits: Traits, config: Config) -> Override | None:
    """Return the override that denies this, or nothing.

    A selector that names services denies these releases, and not what asks for them.
    """
    for override in reversed(config.active_overrides):
        if override.deny and any(
            bool(selector.services) is bool(traits.service) and fits(selector, traits, config)
            for selector in override.select
        ):
            return override
    return None


def suspended(ledger: Ledger, config: Config) -> Iterator[tuple[Claim, Override]]:
    """Yield every suspended claim, sorted, and the override that suspends it."""
    if not any(one.deny for one in config.active_overrides):
        return
    for claim in sorted(ledger, key=lambda one: (str(one.subject), one.demand)):
        override = suspended_by(claim, config)
        if override is not None:
            yield claim, override
