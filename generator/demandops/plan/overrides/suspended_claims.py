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
from demandops.ledger.ledger import Ledger
from demandops.plan.overrides.selectors import Traits, fits, traits_of

_MOST_JUDGED = 100_000
"""Claims that are remembered as judged: a shared service has each of its claims looked at often."""


@dataclass(frozen=True, slots=True)
class UnsuspendedClaims(Ledger):
    """A ledger that does not show suspended claims. For reading only."""

    config: Config | None = field(default=None, compare=False)

    def claims_on(self, subject: Subject) -> tuple[Claim, ...]:
        """Return the claims on ``subject`` that are in force, sorted by demand id."""
        return tuple(claim for claim in Ledger.claims_on(self, subject) if self._stands(claim))

    def is_carried_to(self, target: str, topic: str) -> bool:
        """Tell whether some connection in force brings ``topic`` to the node ``target``."""
        return bool(self.connections_bringing(target, topic))

    def _ids(self, *entry: str) -> tuple[str, ...]:
        found = ((key, self.get(key)) for key in self.index.get(entry) or ())
        return tuple(
            sorted({key.subject.id for key, claim in found if claim and self._stands(claim)})
        )

    def _stands(self, claim: Claim) -> bool:
        return self.config is None or suspended_by(claim, self.config) is None


def without_suspended(ledger: Ledger, config: Config) -> Ledger:
    """Return what of the books is planned; the ledger itself where nothing denies a claim."""
    if isinstance(ledger, UnsuspendedClaims) or not any(one.deny for one in config.in_force):
        return ledger
    return UnsuspendedClaims(ledger.claims, ledger.index, ledger.minutes, config)


def suspended_by(claim: Claim, config: Config) -> Override | None:
    """Return the override that suspends a claim, the highest where several do, or nothing."""
    if not config.in_force:
        return None
    traits = traits_of(claim)
    try:
        return config.judged[traits]
    except KeyError:
        pass
    if len(config.judged) >= _MOST_JUDGED:
        config.judged.clear()
    found = config.judged[traits] = denied_by(traits, config)
    return found


def denied_by(traits: Traits, config: Config) -> Override | None:
    """Return the override that denies this, or nothing.

    A selector that names services denies these releases, and not what asks for them.
    """
    for override in reversed(config.in_force):
        if override.deny and any(
            bool(selector.services) is bool(traits.service) and fits(selector, traits, config)
            for selector in override.select
        ):
            return override
    return None


def suspended_claims(ledger: Ledger, config: Config) -> Iterator[tuple[Claim, Override]]:
    """Yield every suspended claim, sorted, and the override that suspends it."""
    if not any(one.deny for one in config.in_force):
        return
    for claim in sorted(ledger, key=lambda one: (str(one.subject), one.demand)):
        override = suspended_by(claim, config)
        if override is not None:
            yield claim, override
