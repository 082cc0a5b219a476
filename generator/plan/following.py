"""What people's changes of overrides ask of the books: claims that overrides keep, and markers.

An override that had expired when it was merged never applies; one that was in force is ended by a
commit of its own (:func:`due`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime

from generator.catalog.catalog import Catalog
from generator.catalog.override import Override, written
from generator.demand.claim import ClaimKey, Subject
from generator.ledger import format as ledger_format
from generator.ledger import markers
from generator.ledger.ledger import Ledger
from generator.plan import keeping


@dataclass(frozen=True, slots=True)
class TakenIn:
    """Books and configuration with what overrides ask of them, and the ledger's files for it."""

    ledger: Ledger
    catalog: Catalog
    keys: tuple[ClaimKey, ...]
    files: Mapping[str, str | None]


def taken_in(
    before: tuple[Ledger, Catalog],
    after: tuple[Ledger, Catalog],
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
    ledger, catalog = after
    known = {one.name: one for one in before[1].in_force}
    late = [
        one for one in due(catalog, now) if one.name not in known or known[one.name].end != one.end
    ]
    gone = markers.stale(marked, catalog.overrides)
    ended = {name: end for name, end in catalog.ended.items() if markers.path_of(name) not in gone}
    ended |= {one.name: written(one.end) for one in late if one.end}
    catalog = catalog.with_ended(ended)
    files: dict[str, str | None] = dict.fromkeys(gone)
    files |= {markers.path_of(one.name): markers.write(one) for one in late}
    touched = (*subjects, *keeping.subjects_kept(before[0]), *keeping.subjects_kept(ledger))
    settled, keys = keeping.kept(before[0], ledger, dict.fromkeys(touched), (catalog, now))
    files |= files_of(ledger, settled, keys)
    return TakenIn(settled, catalog, tuple(keys), files)


def ended(state: tuple[Ledger, Catalog], override: Override, now: datetime) -> TakenIn:
    """Return books and configuration without an override whose time is over."""
    ledger, catalog = state
    if override.end is None:
        raise ValueError(f"{override.path} has no end")
    after = catalog.with_ended({**catalog.ended, override.name: written(override.end)})
    found = taken_in(state, (ledger, after), (), {}, now)
    marker = {markers.path_of(override.name): markers.write(override)}
    return TakenIn(found.ledger, found.catalog, found.keys, {**found.files, **marker})


def files_of(before: Ledger, after: Ledger, keys: Iterable[ClaimKey]) -> dict[str, str | None]:
    """Return the claim files at ``keys`` that differ (``None``: to remove)."""
    files: dict[str, str | None] = {}
    for key in keys:
        claim = after.get(key)
        if claim != before.get(key):
            files[ledger_format.path_of(key)] = ledger_format.write(claim) if claim else None
    return files


def due(catalog: Catalog, now: datetime) -> list[Override]:
    """Return the overrides in force whose time is over, the first to end first."""
    over = [(one.end, one.name, one) for one in catalog.in_force if one.end and one.end <= now]
    return [one for _, _, one in sorted(over, key=lambda item: item[:2])]


def next_end(catalog: Catalog) -> datetime | None:
    """Return when the next override in force ends."""
    return min((one.end for one in catalog.in_force if one.end), default=None)


def differing(before: Catalog, after: Catalog) -> list[str]:
    """Return the files of the overrides that came into force, changed or ceased to apply."""
    old = {one.name: one for one in before.in_force}
    new = {one.name: one for one in after.in_force}
    names = [name for name in {*old, *new} if old.get(name) != new.get(name)]
    return sorted((new.get(name) or old[name]).path for name in names)
