"""``keep``: what runs goes on without a demand, by a claim of the override's own.

When the last claim on a subject goes, one with the same content is booked in the owner's name; it
gives way as soon as somebody asks again. Bookkeeping, history and files then explain it by
themselves.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime

from demandops.config.config import Config
from demandops.config.override import Override
from demandops.demand.claim import Claim, ClaimKey, Subject, SubjectKind, is_override_claim
from demandops.demand.demand_request import OVERRIDE_PREFIX, DemandRequest
from demandops.ledger.apply import Changes, Ledger
from demandops.ledger.ledger import differences
from demandops.plan.overrides.claims_in_force import suspended_by
from demandops.plan.overrides.selectors import selects, traits_of


def requested(request: DemandRequest) -> tuple[Subject, ...]:
    """Return the subjects that a request lists."""
    return (
        *(Subject(SubjectKind.APPLICATION, app.id) for app in request.applications),
        *(Subject(SubjectKind.CONNECTION, one.id) for one in request.connections),
    )


def giving_way(ledger: Ledger, subjects: Iterable[Subject]) -> Ledger:
    """Return the ledger without the overrides' own claims on these subjects."""
    for subject in subjects:
        for claim in ledger.of(subject):
            if is_override_claim(claim):
                ledger = ledger.replace(claim.key, None)
    return ledger


def settled(
    before: Ledger,
    after: Ledger,
    changes: Changes,
    subjects: Iterable[Subject],
    world: tuple[Config, datetime],
) -> tuple[Ledger, Changes]:
    """Return a booking with what overrides keep, or no longer keep, of what it touched."""
    keys = [change.key for change in changes.claims]
    touched = dict.fromkeys((*changes.subjects(), *subjects))
    after, more = kept(before, after, touched, world)
    return after, replace(changes, claims=differences(before, after, [*keys, *more]))


def kept(
    before: Ledger, after: Ledger, subjects: Iterable[Subject], world: tuple[Config, datetime]
) -> tuple[Ledger, list[ClaimKey]]:
    """Return ``after`` with just the claims of overrides' own that belong there, and their keys.

    Args:
        before, after: the books before and after a change.
        subjects: what changed.
        world: the configuration and the time for claims that are made.
    """
    keys: list[ClaimKey] = []
    for subject in subjects:
        own = [c for c in (*after.of(subject), *before.of(subject)) if is_override_claim(c)]
        wanted = None
        if all(is_override_claim(claim) for claim in after.of(subject)):
            wanted = _wanted(own, before.of(subject), world)
        for claim in own:
            keys.append(claim.key)
            after = after.replace(claim.key, None)
        if wanted is not None:
            keys.append(wanted.key)
            after = after.replace(wanted.key, wanted)
    return after, keys


def subjects_kept(ledger: Ledger) -> tuple[Subject, ...]:
    """Return every subject that an override's own claim holds."""
    found = {claim.subject for claim in ledger if is_override_claim(claim)}
    return tuple(sorted(found, key=str))


def _wanted(
    own: list[Claim], stood: tuple[Claim, ...], world: tuple[Config, datetime]
) -> Claim | None:
    config, now = world
    for claim in own:
        if any(OVERRIDE_PREFIX + one.name == claim.demand for one in keepers(claim, config)):
            return claim
    if not stood:
        return None
    last = max(stood, key=lambda claim: (claim.booked, claim.demand))
    if suspended_by(last, config) is not None:
        return None
    for override in keepers(last, config):
        name = OVERRIDE_PREFIX + override.name
        return replace(
            last, demand=name, request=name, requesters=(override.owner,), booked=now, lease=None
        )
    return None


def keepers(claim: Claim, config: Config) -> list[Override]:
    """Return the overrides that keep what a claim holds, the highest first.

    One of an override's own stands in its owner's name, so there ``requesters`` has been judged.
    """
    traits, whoever = traits_of(claim), is_override_claim(claim)
    return [
        one
        for one in reversed(config.active_overrides)
        if one.keep and selects(one, traits, config, whoever_asks=whoever)
    ]
