"""Claims that an override's ``deny`` suspends, and a view of the ledger without them.

A suspended claim stays booked but is not planned. The planner reads the view, which checks each
claim when it is read. So there is no second ledger to keep up to date.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace

from demandops.config.override import Override
from demandops.demand.claim import Claim, ClaimKey
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World
from demandops.plan.overrides.selectors import Traits, fits, traits_of
from demandops.subject import Subject


@dataclass(frozen=True, slots=True)
class UnsuspendedClaims(Ledger):
    """A read-only view of a ledger without suspended claims."""

    world: World | None = field(default=None, compare=False)

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
        return self.world is None or suspended_by(claim, self.world) is None


def without_suspended(world: World) -> World:
    """Return the world with a view of its ledger without suspended claims."""
    ledger = world.ledger
    if isinstance(ledger, UnsuspendedClaims) or not any(one.deny for one in world.overrides):
        return world
    parts = (getattr(ledger, part.name) for part in fields(Ledger))
    view = replace(UnsuspendedClaims(*parts), world=world)
    return replace(world, ledger=view)


def suspended_by(claim: Claim, world: World) -> Override | None:
    """Return the highest override that suspends a claim, or ``None``."""
    return denied_by(traits_of(claim), world) if world.overrides else None


def denied_by(traits: Traits, world: World) -> Override | None:
    """Return the highest override that denies something with these traits, or ``None``.

    A selector that names services denies the releases of these services, never a claim or demand.
    """
    for override in reversed(world.overrides):
        if override.deny and any(
            bool(selector.services) is bool(traits.service) and fits(selector, traits, world.config)
            for selector in override.select
        ):
            return override
    return None


def suspended_claims(world: World) -> Iterator[tuple[Claim, Override]]:
    """Yield every suspended claim and the override that suspends it, sorted by subject."""
    if not any(one.deny for one in world.overrides):
        return
    for claim in sorted(world.ledger, key=lambda one: (str(one.subject), one.demand)):
        override = suspended_by(claim, world)
        if override is not None:
            yield claim, override
