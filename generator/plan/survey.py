"""What each override does at present: for ``demandops overrides`` and ``check``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from generator.catalog.catalog import Catalog
from generator.catalog.override import Override, written
from generator.ledger.ledger import Ledger
from generator.plan import keeping
from generator.plan.planner import all_keys, denied, plan
from generator.plan.standing import suspended_by

Standing = Literal["in force", "expired", "matches nothing"]


@dataclass(frozen=True, slots=True)
class Entry:
    """An override, and the releases and claims that it is for now."""

    override: Override
    state: Standing
    releases: tuple[str, ...]
    claims: tuple[str, ...]


def survey(ledger: Ledger, catalog: Catalog, now: datetime) -> list[Entry]:
    """Return every override that lies there, by name, and what it does."""
    releases = _releases(ledger, catalog)
    claims = _claims(ledger, catalog)
    found = []
    for name, override in sorted(catalog.overrides.items()):
        entry = (
            tuple(sorted(releases.get(name, ()))),
            tuple(sorted(claims.get(name, ()))),
        )
        standing: Standing = "in force" if any(entry) else "matches nothing"
        over = override.end is not None and override.end <= now
        if over or override not in catalog.in_force:
            standing, entry = "expired", ((), ())
        found.append(Entry(override, standing, *entry))
    return found


def warnings(entries: list[Entry]) -> Iterator[tuple[str, str]]:
    """Yield (file, warning) for each override that does nothing."""
    for entry in entries:
        override = entry.override
        if entry.state == "expired" and override.end:
            yield (
                override.path,
                f"expired at {written(override.end)} and applies no more; remove the file, or "
                "write a later time",
            )
        elif entry.state == "matches nothing":
            yield override.path, "matches nothing at present; mend select if it should"


def _releases(ledger: Ledger, catalog: Catalog) -> dict[str, set[str]]:
    """Return override → the releases that it shapes, or keeps from running."""
    found: dict[str, set[str]] = {}
    for key in all_keys(ledger, catalog):
        release = plan(ledger, catalog, key)
        if release is not None:
            for override, _ in release.shaping.by:
                found.setdefault(override.name, set()).add(release.name)
            continue
        stopped = denied(ledger, catalog, key)
        if stopped is not None:
            found.setdefault(stopped[1].name, set()).add(stopped[0].name)
    return found


def _claims(ledger: Ledger, catalog: Catalog) -> dict[str, set[str]]:
    """Return override → the subjects that it suspends, or would keep."""
    found: dict[str, set[str]] = {}
    for claim in ledger:
        by = [suspended_by(claim, catalog), *keeping.keepers(claim, catalog)]
        for override in by:
            if override is not None:
                found.setdefault(override.name, set()).add(f"{claim.subject} of {claim.demand}")
    return found
