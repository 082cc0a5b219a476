"""What people's changes of overrides ask of the books: claims that overrides keep, and markers.

An override that had expired when it was merged never applies; one that was in force is ended by a
commit of its own (:func:`due`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime

from demandops.config.config import Config
from demandops.config.override import Override, format_time
from demandops.demand.claim import ClaimKey, Subject
from demandops.ledger import claim_file as ledger_format
from demandops.ledger import ended_override_file
from demandops.ledger.apply import Ledger
from demandops.plan.overrides import kept_claims


@dataclass(frozen=True, slots=True)
class TakenIn:
    """Books and configuration with what overrides ask of them, and the ledger's files for it."""

    ledger: Ledger
    config: Config
    keys: tuple[ClaimKey, ...]
    files: Mapping[str, str | None]


def taken_in(
    before: tuple[Ledger, Config],
    after: tuple[Ledger, Config],
    subjects: Iterable[Subject],
    marked: Mapping[str, str],
    now: datetime,
) -> TakenIn:
    """Return what a change of the configuration asks of the books.

    Args:
        before, after: books and configuration on either side of the change.
        subjects: those whose claims people changed.
        marked: the markers as they are, path → text.
        now: overrides that are new and ended by then do not apply.
    """
    ledger, config = after
    known = {one.name: one for one in before[1].active_overrides}
    late = [
        one for one in due(config, now) if one.name not in known or known[one.name].end != one.end
    ]
    gone = ended_override_file.stale(marked, config.overrides)
    ended = {
        name: end
        for name, end in config.ended_overrides.items()
        if ended_override_file.path_of(name) not in gone
    }
    ended |= {one.name: format_time(one.end) for one in late if one.end}
    config = config.with_ended_overrides(ended)
    files: dict[str, str | None] = dict.fromkeys(gone)
    files |= {ended_override_file.path_of(one.name): ended_override_file.write(one) for one in late}
    touched = (*subjects, *kept_claims.subjects_kept(before[0]), *kept_claims.subjects_kept(ledger))
    settled, keys = kept_claims.kept(before[0], ledger, dict.fromkeys(touched), (config, now))
    files |= files_of(ledger, settled, keys)
    return TakenIn(settled, config, tuple(keys), files)


def ended(state: tuple[Ledger, Config], override: Override, now: datetime) -> TakenIn:
    """Return books and configuration without an override whose time is over."""
    ledger, config = state
    if override.end is None:
        raise ValueError(f"{override.path} has no end")
    after = config.with_ended_overrides(
        {**config.ended_overrides, override.name: format_time(override.end)}
    )
    found = taken_in(state, (ledger, after), (), {}, now)
    marker = {ended_override_file.path_of(override.name): ended_override_file.write(override)}
    return TakenIn(found.ledger, found.config, found.keys, {**found.files, **marker})


def files_of(before: Ledger, after: Ledger, keys: Iterable[ClaimKey]) -> dict[str, str | None]:
    """Return the claim files at ``keys`` that differ (``None``: to remove)."""
    files: dict[str, str | None] = {}
    for key in keys:
        claim = after.get(key)
        if claim != before.get(key):
            files[ledger_format.path_of(key)] = ledger_format.write(claim) if claim else None
    return files


def due(config: Config, now: datetime) -> list[Override]:
    """Return the overrides in force whose time is over, the first to end first."""
    over = [
        (one.end, one.name, one) for one in config.active_overrides if one.end and one.end <= now
    ]
    return [one for _, _, one in sorted(over, key=lambda item: item[:2])]


def next_end(config: Config) -> datetime | None:
    """Return when the next override in force ends."""
    return min((one.end for one in config.active_overrides if one.end), default=None)


def differing(before: Config, after: Config) -> list[str]:
    """Return the files of the overrides that came into force, changed or ceased to apply."""
    old = {one.name: one for one in before.active_overrides}
    new = {one.name: one for one in after.active_overrides}
    names = [name for name in {*old, *new} if old.get(name) != new.get(name)]
    return sorted((new.get(name) or old[name]).path for name in names)
