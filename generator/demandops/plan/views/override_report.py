"""What each override does at present: for ``demandops overrides`` and ``check``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from demandops.config.config import Config
from demandops.config.override import Override, format_time
from demandops.ledger.apply import Ledger
from demandops.plan.overrides import kept_claims
from demandops.plan.overrides.claims_in_force import suspended_by
from demandops.plan.planner import denied, plan
from demandops.plan.release_keys import all_keys

Standing = Literal["in force", "expired", "matches nothing"]


@dataclass(frozen=True, slots=True)
class Entry:
    """An override, and the releases and claims that it is for now."""

    override: Override
    state: Standing
    releases: tuple[str, ...]
    claims: tuple[str, ...]


def survey(ledger: Ledger, config: Config, now: datetime) -> list[Entry]:
    """Return every override that lies there, by name, and what it does."""
    releases = _releases(ledger, config)
    claims = _claims(ledger, config)
    found = []
    for name, override in sorted(config.overrides.items()):
        entry = (
            tuple(sorted(releases.get(name, ()))),
            tuple(sorted(claims.get(name, ()))),
        )
        standing: Standing = "in force" if any(entry) else "matches nothing"
        over = override.end is not None and override.end <= now
        if over or override not in config.active_overrides:
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
                f"expired at {format_time(override.end)} and applies no more; remove the file, or "
                "write a later time",
            )
        elif entry.state == "matches nothing":
            yield override.path, "matches nothing at present; mend select if it should"


def _releases(ledger: Ledger, config: Config) -> dict[str, set[str]]:
    """Return override → the releases that it shapes, or keeps from running."""
    found: dict[str, set[str]] = {}
    for key in all_keys(ledger, config):
        release = plan(ledger, config, key)
        if release is not None:
            for override, _ in release.shaping.by:
                found.setdefault(override.name, set()).add(release.name)
            continue
        stopped = denied(ledger, config, key)
        if stopped is not None:
            found.setdefault(stopped[1].name, set()).add(stopped[0].name)
    return found


def _claims(ledger: Ledger, config: Config) -> dict[str, set[str]]:
    """Return override → the subjects that it suspends, or would keep."""
    found: dict[str, set[str]] = {}
    for claim in ledger:
        by = [suspended_by(claim, config), *kept_claims.keepers(claim, config)]
        for override in by:
            if override is not None:
                found.setdefault(override.name, set()).add(f"{claim.subject} of {claim.demand}")
    return found
