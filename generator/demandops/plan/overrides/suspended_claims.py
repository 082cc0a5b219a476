"""Claims that an override's ``deny`` suspends, and a view of the ledger without them.

A suspended claim stays booked but is not planned. The planner reads the view, which checks each
claim when it is read. So there is no second ledger to keep up to date.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from demandops.config.config import Config
from demandops.config.override import Override
from demandops.demand.claim import Claim, ClaimKey
from demandops.ledger.ledger import Ledger
from demandops.plan.overrides.selectors import Traits, fits, traits_of
from demandops.subject import Subject

_MOST_CACHED = 100_000
"""How many results are cached. The claims of a shared service are read often."""


@dataclass(frozen=True, slots=True)
class UnsuspendedClaims(Ledger):
    """A read-only view of a ledger without suspended claims."""

    config: Config | None = field(default=None, compare=False)

    def claims_on(self, subject: Subject) -> tuple[Claim, ...]:
        """Return the claims on ``subject`` that are not suspended, sorted by demand id."""
        return tuple(claim for claim in Ledger.claims_on(self, subject) if self._is_active(claim))

    def first_claim(self, subject: Subject) -> Claim | None:
        """Return the first claim on ``subject`` that is not suspended, or ``None``."""
        first = Ledger.first_claim(self, subject)
        if first is None or self._is_active(first):
            return first
        return next(iter(self.claims_on(subject)), None)

    def get(self, key: ClaimKey) -> Claim | None:
        """Return one claim, or ``None`` if it is suspended."""
        claim = Ledger.get(self, key)
        return claim if claim and self._is_active(claim) else None

    def is_carried_to(self, target: str, topic: str) -> bool:
        """Return whether a claimed connection brings ``topic`` to the node ``target``."""
        return bool(self.connections_bringing(target, topic))

    def _ids(self, *entry: str) -> tuple[str, ...]:
        keys = self.index.get(entry) or ()
        return tuple(sorted({key.subject.id for key in keys if self.get(key)}))

    def _is_active(self, claim: Claim) -> bool:
        return self.config is None or suspended_by(claim, self.config) is None


def without_suspended(ledger: Ledger, config: Config) -> Ledger:
    """Return a view of the ledger without suspended claims."""
    if isinstance(ledger, UnsuspendedClaims) or not any(
        one.deny for one in config.active_overrides
    ):
        return ledger
    return UnsuspendedClaims(ledger.claims, ledger.index, ledger.minutes, config)


def suspended_by(claim: Claim, config: Config) -> Override | None:
    """Return the highest override that suspends a claim, or ``None``."""
    if not config.active_overrides:
        return None
    traits = traits_of(claim)
    try:
        return config.denial_cache[traits]
    except KeyError:
        pass
    if len(config.denial_cache) >= _MOST_CACHED:
        config.denial_cache.clear()
    found = config.denial_cache[traits] = denied_by(traits, config)
    return found


def denied_by(traits: Traits, config: Config) -> Override | None:
    """Return the highest override that denies something with these traits, or ``None``.

    A selector that names services denies the releases of these services, never a claim or demand.
    """
    for override in reversed(config.active_overrides):
        if override.deny and any(
            bool(selector.services) is bool(traits.service) and fits(selector, traits, config)
            for selector in override.select
        ):
            return override
    return None


def suspended_claims(ledger: Ledger, config: Config) -> Iterator[tuple[Claim, Override]]:
    """Yield every suspended claim and the override that suspends it, sorted by subject."""
    if not any(one.deny for one in config.active_overrides):
        return
    for claim in sorted(ledger, key=lambda one: (str(one.subject), one.demand)):
        override = suspended_by(claim, config)
        if override is not None:
            yield claim, override
