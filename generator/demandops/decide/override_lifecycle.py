"""Changes to the ledger when overrides change or end: kept claims, moved services, markers.

A marker is a file of the ledger that records that an override has ended. When an override in effect
reaches its end, the generator publishes a commit with the marker. Until then the override stays in
effect, so what runs depends on files alone and not on a clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.base.naming import Subject
from demandops.decide.placement.relocation import following_overrides
from demandops.decide.planning.overrides import kept_subjects, update_kept_claims
from demandops.model.config.override import Override, format_time
from demandops.model.demand.claim import ClaimKey
from demandops.model.ledger import claim_file, records
from demandops.model.ledger.ledger import Ledger, World


@dataclass(frozen=True, slots=True)
class LedgerUpdate:
    """The ledger after a change of overrides or claims, and the ledger files to write.

    ``keys`` are the keys of the claims that may have changed. A file with ``None`` is removed.
    """

    ledger: Ledger
    keys: tuple[ClaimKey, ...]
    files: Mapping[str, str | None]
    # (file, reason) for each override and each application whose service it cannot move
    stays: tuple[tuple[str, str], ...] = ()


def update_ledger(
    before: World,
    after: World,
    subjects: Iterable[Subject],
    markers: Mapping[str, str],
    now: datetime,
) -> LedgerUpdate:
    """Return the ledger that a change of the configuration requires, and the files to write.

    ``subjects`` are those whose claims a person changed. ``markers`` are the ledger's markers of
    ended overrides, by path. ``now`` is also the booking time of claims that an override books.
    """
    # An override that is merged after its end never applies. One that was in effect before stays
    # in effect until the generator's own commit ends it.
    in_effect = {override.name: override.end for override in before.overrides}
    expired = [
        override
        for override in expired_overrides(after, now)
        if override.name not in in_effect or in_effect[override.name] != override.end
    ]
    stale = records.stale_markers(markers, after.config.overrides)
    ended = {
        name: end
        for name, end in after.ledger.ended.items()
        if records.ended_override_path(name) not in stale
    }
    ended |= {each.name: format_time(each.end) for each in expired if each.end}
    files: dict[str, str | None] = dict.fromkeys(stale)
    for override in expired:
        files |= _marker(override)
    after = replace(after, ledger=replace(after.ledger, ended=ended))
    kept = (*kept_subjects(before.ledger), *kept_subjects(after.ledger))
    update = update_claims(before.ledger, after, dict.fromkeys((*subjects, *kept)), now)
    moved = following_overrides(replace(after, ledger=update.ledger))
    keys = (*update.keys, *moved.keys)
    files |= changed_claim_files(after.ledger, moved.ledger, keys)
    return LedgerUpdate(moved.ledger, keys, files, moved.stays)


def update_claims(
    before: Ledger, after: World, subjects: Iterable[Subject], now: datetime
) -> LedgerUpdate:
    """After claims changed, update the kept claims and the moved services on these subjects.

    ``before`` is the ledger before the change, ``after`` the world after it. ``now`` is the booking
    time of each claim that an override books.
    """
    subjects = tuple(subjects)
    ledger, kept = update_kept_claims(before, after, subjects, now)
    moved = following_overrides(replace(after, ledger=ledger), subjects)
    keys = (*kept, *moved.keys)
    files = changed_claim_files(after.ledger, moved.ledger, keys)
    return LedgerUpdate(moved.ledger, keys, files, moved.stays)


def end_override(world: World, override: Override, now: datetime) -> LedgerUpdate:
    """Return the ledger after the end of an override, and the files to write with the marker."""
    if override.end is None:
        raise ValueError(f"{override.path} has no end")
    ended = {**world.ledger.ended, override.name: format_time(override.end)}
    after = replace(world, ledger=replace(world.ledger, ended=ended))
    update = update_ledger(world, after, (), {}, now)
    return replace(update, files={**update.files, **_marker(override)})


def _marker(override: Override) -> dict[str, str]:
    return {records.ended_override_path(override.name): records.ended_override_text(override)}


def changed_claim_files(
    before: Ledger, after: Ledger, keys: Iterable[ClaimKey]
) -> dict[str, str | None]:
    """Return the new texts of the files of changed claims, by path; ``None`` removes a file."""
    files: dict[str, str | None] = {}
    for key in keys:
        claim = after.get(key)
        if claim != before.get(key):
            files[claim_file.path_of(key)] = claim_file.text_of(claim) if claim else None
    return files


def expired_overrides(world: World, now: datetime) -> list[Override]:
    """Return the overrides in effect although their end has passed, sorted by end."""
    expired = [
        (override.end, override.name, override)
        for override in world.overrides
        if override.end and override.end <= now
    ]
    return [override for _, _, override in sorted(expired, key=lambda item: item[:2])]


def changed_override_files(before: World, after: World) -> list[str]:
    """Return, sorted, the paths of the overrides that come into effect, change or end."""
    old = {override.name: override for override in before.overrides}
    new = {override.name: override for override in after.overrides}
    names = [name for name in {*old, *new} if old.get(name) != new.get(name)]
    return sorted((new.get(name) or old[name]).path for name in names)
