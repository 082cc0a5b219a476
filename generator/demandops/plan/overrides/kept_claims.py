"""``keep``: an override holds its own claim, so a subject runs without a demand.

When the last claim on a subject is released, a claim with the same content is booked for the
override's owner. It is removed when a demand asks for the subject again. Because it is a claim,
bookkeeping and history show it like any other.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime

from demandops.config.override import Override
from demandops.demand.claim import OVERRIDE_PREFIX, Claim, ClaimKey
from demandops.ledger.ledger import Changes, Ledger, claim_changes
from demandops.ledger.world import World
from demandops.plan.overrides.selectors import selects, traits_of
from demandops.plan.overrides.suspended_claims import suspended_by
from demandops.subject import Subject


def without_kept_claims(ledger: Ledger, subjects: Iterable[Subject]) -> Ledger:
    """Return the ledger without the kept claims on these subjects."""
    for subject in subjects:
        ledger = ledger.without(ledger.kept_claims(subject))
    return ledger


def with_kept_claims(
    before: Ledger, after: World, changes: Changes, subjects: Iterable[Subject], now: datetime
) -> tuple[Ledger, Changes]:
    """Return a booking with the kept claims updated on the subjects that it changed."""
    keys = [change.key for change in changes.claims]
    touched = dict.fromkeys((*changes.subjects(), *subjects))
    ledger, more = update_kept_claims(before, after, touched, now)
    return ledger, replace(changes, claims=claim_changes(before, ledger, [*keys, *more]))


def update_kept_claims(
    before: Ledger, after: World, subjects: Iterable[Subject], now: datetime
) -> tuple[Ledger, list[ClaimKey]]:
    """Return the ledger with exactly the kept claims that overrides ask for, and their keys.

    Args:
        before: the ledger before a change.
        after: the world after it.
        subjects: the subjects that changed.
        now: the booking time of new kept claims.
    """
    keys, ledger = list[ClaimKey](), after.ledger
    for subject in subjects:
        existing = [*ledger.kept_claims(subject), *before.kept_claims(subject)]
        needed = None
        if ledger.is_only_kept(subject):
            needed = _needed(existing, before.claims_on(subject), after, now)
        keys += [claim.key for claim in existing]
        ledger = ledger.without(existing)
        if needed is not None:
            keys.append(needed.key)
            ledger = ledger.replace(needed.key, needed)
    return ledger, keys


def kept_subjects(ledger: Ledger) -> tuple[Subject, ...]:
    """Return every subject with a kept claim, sorted."""
    return tuple(dict.fromkeys(claim.subject for claim in ledger.kept_claims()))


def _needed(
    existing: list[Claim], before: tuple[Claim, ...], world: World, now: datetime
) -> Claim | None:
    """Return the kept claim that a subject without demands needs, or ``None``."""
    for claim in existing:
        if any(one.name == claim.keeping_override for one in keeping_overrides(claim, world)):
            return claim
    if not before:
        return None
    last = max(before, key=lambda claim: (claim.booked, claim.demand))
    if suspended_by(last, world) is not None:
        return None
    for override in keeping_overrides(last, world):
        name = OVERRIDE_PREFIX + override.name
        return replace(
            last,
            demand=name,
            request=name,
            requesters=(override.owner,),
            booked=now,
            lease=None,
            joined=False,
            partial={},
        )
    return None


def keeping_overrides(claim: Claim, world: World) -> list[Override]:
    """Return the overrides that keep the subject of a claim, the highest first.

    A kept claim names the owner as its requester, so ``requesters`` of the selector is ignored: it
    was matched against the original claim.
    """
    traits, any_requester = traits_of(claim), claim.keeping_override is not None
    return [
        one
        for one in reversed(world.overrides)
        if one.keep and selects(one, traits, world.config, any_requester=any_requester)
    ]
