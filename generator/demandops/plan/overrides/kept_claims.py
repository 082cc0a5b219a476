"""``keep``: the override has a claim of its own, so a subject runs without a demand.

When the last claim on a subject is released, a claim with the same content is booked for the
override's owner. It is removed when a demand asks for the subject again. Because it is a claim,
bookkeeping and history show it like any other.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime

from demandops.config.config import Config
from demandops.config.override import Override
from demandops.demand.claim import OVERRIDE_PREFIX, Claim, ClaimKey
from demandops.ledger.ledger import Changes, Ledger, claim_changes
from demandops.plan.overrides.selectors import selects, traits_of
from demandops.plan.overrides.suspended_claims import suspended_by
from demandops.subject import Subject


def without_kept_claims(ledger: Ledger, subjects: Iterable[Subject]) -> Ledger:
    """Return the ledger without the kept claims on these subjects."""
    for subject in subjects:
        ledger = ledger.without(ledger.kept_claims(subject))
    return ledger


def with_kept_claims(
    before: Ledger,
    after: Ledger,
    changes: Changes,
    subjects: Iterable[Subject],
    config: Config,
    now: datetime,
) -> tuple[Ledger, Changes]:
    """Return a booking with the kept claims updated on everything that it touched."""
    keys = [change.key for change in changes.claims]
    touched = dict.fromkeys((*changes.subjects(), *subjects))
    after, more = update_kept_claims(before, after, touched, config, now)
    return after, replace(changes, claims=claim_changes(before, after, [*keys, *more]))


def update_kept_claims(
    before: Ledger, after: Ledger, subjects: Iterable[Subject], config: Config, now: datetime
) -> tuple[Ledger, list[ClaimKey]]:
    """Return ``after`` with exactly the kept claims that its overrides ask for, and their keys.

    Args:
        before, after: the ledger before and after a change.
        subjects: the subjects that changed.
        config: the configuration after the change.
        now: the booking time of new kept claims.
    """
    keys: list[ClaimKey] = []
    for subject in subjects:
        existing = [*after.kept_claims(subject), *before.kept_claims(subject)]
        needed = None
        if after.is_only_kept(subject):
            needed = _needed(existing, before.claims_on(subject), config, now)
        keys += [claim.key for claim in existing]
        after = after.without(existing)
        if needed is not None:
            keys.append(needed.key)
            after = after.replace(needed.key, needed)
    return after, keys


def kept_subjects(ledger: Ledger) -> tuple[Subject, ...]:
    """Return every subject with a kept claim, sorted."""
    return tuple(dict.fromkeys(claim.subject for claim in ledger.kept_claims()))


def _needed(
    existing: list[Claim], before: tuple[Claim, ...], config: Config, now: datetime
) -> Claim | None:
    """Return the kept claim that a subject without demands needs, or ``None``."""
    for claim in existing:
        if any(one.name == claim.keeping_override for one in keeping_overrides(claim, config)):
            return claim
    if not before:
        return None
    last = max(before, key=lambda claim: (claim.booked, claim.demand))
    if suspended_by(last, config) is not None:
        return None
    for override in keeping_overrides(last, config):
        name = OVERRIDE_PREFIX + override.name
        return replace(
            last, demand=name, request=name, requesters=(override.owner,), booked=now, lease=None
        )
    return None


def keeping_overrides(claim: Claim, config: Config) -> list[Override]:
    """Return the overrides that keep the subject of a claim, the highest first.

    A kept claim names the owner as its requester, so ``requesters`` of the selector is ignored: it
    was matched against the original claim.
    """
    traits, any_requester = traits_of(claim), claim.keeping_override is not None
    return [
        one
        for one in reversed(config.active_overrides)
        if one.keep and selects(one, traits, config, any_requester=any_requester)
    ]
