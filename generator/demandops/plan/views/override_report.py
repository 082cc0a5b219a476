"""The override report: what each override does now, for ``demandops overrides`` and ``check``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from demandops.config.override import Override, format_time
from demandops.ledger.world import World
from demandops.plan.overrides import kept_claims
from demandops.plan.overrides.suspended_claims import suspended_by
from demandops.plan.planner import denied_release, plan
from demandops.plan.release_keys import all_keys

State = Literal["in force", "expired", "matches nothing"]


@dataclass(frozen=True, slots=True)
class Entry:
    """An override, and the releases and claims that it applies to now."""

    override: Override
    state: State
    releases: tuple[str, ...]
    claims: tuple[str, ...]


def override_report(world: World, now: datetime) -> list[Entry]:
    """Return every override, sorted by name, with what it does."""
    releases = _releases(world)
    claims = _claims(world)
    found = []
    for name, override in sorted(world.config.overrides.items()):
        entry = (
            tuple(sorted(releases.get(name, ()))),
            tuple(sorted(claims.get(name, ()))),
        )
        state: State = "in force" if any(entry) else "matches nothing"
        expired = override.end is not None and override.end <= now
        if expired or override not in world.overrides:
            state, entry = "expired", ((), ())
        found.append(Entry(override, state, *entry))
    return found


def warnings(entries: list[Entry]) -> Iterator[tuple[str, str]]:
    """Yield (file, warning) for each override that does nothing."""
    for entry in entries:
        override = entry.override
        if entry.state == "expired" and override.end:
            yield (
                override.path,
                f"expired at {format_time(override.end)} and no longer applies; remove the file, "
                "or write a later time",
            )
        elif entry.state == "matches nothing":
            yield override.path, "matches nothing now; if it should, correct select"


def _releases(world: World) -> dict[str, set[str]]:
    """Return override → the releases that it changes or denies."""
    found: dict[str, set[str]] = {}
    for key in all_keys(world):
        release = plan(world, key)
        if release is not None:
            for override, _ in release.shaping.by:
                found.setdefault(override.name, set()).add(release.name)
            continue
        stopped = denied_release(world, key)
        if stopped is not None:
            found.setdefault(stopped[1].name, set()).add(stopped[0].name)
    return found


def _claims(world: World) -> dict[str, set[str]]:
    """Return override → the claims that it suspends or would keep."""
    found: dict[str, set[str]] = {}
    for claim in world.ledger:
        by = [suspended_by(claim, world), *kept_claims.keeping_overrides(claim, world)]
        for override in by:
            if override is not None:
                found.setdefault(override.name, set()).add(f"{claim.subject} of {claim.demand}")
    return found
