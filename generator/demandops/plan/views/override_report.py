"""The override report, for ``get overrides`` and ``check``: the effect of each override now."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Literal

from demandops.config.override import Override, format_time
from demandops.demand.claim import Claim
from demandops.ledger.world import World
from demandops.plan.overrides import claim_overrides
from demandops.plan.overrides.claim_overrides import suspended_by
from demandops.plan.planner import denied_release, plan
from demandops.plan.release import Release, ServiceRelease
from demandops.plan.release_keys import all_keys, keys_of_claims
from demandops.plan.replicas import most_replicas

State = Literal["in force", "held back", "expired", "matches nothing", "not rendered yet"]
"""The state of an override.

``matches nothing``: the override selects nothing, or its effects do not apply to what it selects.
``held back``: another override with ``hold`` keeps every file that this override would change.
``not rendered yet``: a generator has not written the changed files yet
(:mod:`demandops.render.changes.override_state`).
"""


@dataclass(frozen=True, slots=True)
class Entry:
    """An override, and the releases and claims to which it applies now."""

    override: Override
    state: State
    releases: tuple[Release, ...]
    claims: tuple[Claim, ...]


def override_report(world: World, now: datetime) -> list[Entry]:
    """Return an entry for every override, sorted by name.

    Raises:
        Refused: for the same reasons as :func:`demandops.plan.planner.plan`.
    """
    if not world.config.overrides:
        return []
    releases = _releases(world)
    claims = _claims(world)
    found = []
    for name, override in sorted(world.config.overrides.items()):
        applied = sorted(releases[name], key=lambda one: one.name), claims[name]
        state: State = "in force" if any(applied) else "matches nothing"
        if applied[0] and not applied[1] and all(_is_held(one, override) for one in applied[0]):
            state = "held back"
        expired = override.end is not None and override.end <= now
        if expired or override not in world.overrides:
            state, applied = "expired", ([], [])
        found.append(Entry(override, state, tuple(applied[0]), tuple(applied[1])))
    return found


def affected_releases(entry: Entry, world: World) -> list[Release]:
    """Return the releases that an override changes, denies, or stops by suspending claims."""
    others = {name: one for name, one in world.config.overrides.items() if one != entry.override}
    without = World(replace(world.config, overrides=others), world.ledger)
    runs = {*all_keys(world)} if entry.claims else set()
    needed = (key for key in keys_of_claims(without, entry.claims) if key not in runs)
    stopped = [one for one in (plan(without, key) for key in needed) if one is not None]
    return sorted({one.name: one for one in (*entry.releases, *stopped)}.values(), key=_name)


def _name(release: Release) -> str:
    return release.name


def warnings(entries: list[Entry]) -> Iterator[tuple[str, str]]:
    """Yield (file, warning) for each override that has no effect.

    There is also a warning if several replicas publish the same outputs because of an override.
    """
    for entry in entries:
        override = entry.override
        if entry.state == "expired" and override.end:
            yield (
                override.path,
                f"expired at {format_time(override.end)}; remove the file, or write a later time",
            )
        elif entry.state == "matches nothing":
            yield (
                override.path,
                "has no effect now, because its field 'select' matches nothing, or nothing to "
                "which its effects apply; if it should have an effect, correct it",
            )
        elif entry.state == "held back":
            yield (
                override.path,
                "changes nothing, because another override with 'hold' keeps the same files as "
                "they are; remove one of the two overrides, or give this one a higher priority",
            )
        elif doubled := sorted({*_doubled(entry)}):
            yield (
                override.path,
                f"runs {override.replicas} replicas of {' and '.join(doubled)}, and each replica "
                "publishes every output; run only one, or set dividesWork: true in 'scaling' of "
                "the service's definition if the program divides its work among replicas",
            )


def _is_held(release: Release, override: Override) -> bool:
    """Return whether another override with ``hold`` keeps ``override`` from changing a release."""
    effects = next((effects for by, effects in release.shaping.by if by == override), ())
    return release.shaping.held and "hold" not in effects and {*effects} != {"keep"}


def _doubled(entry: Entry) -> Iterator[str]:
    """Yield each service whose messages are published several times because of an override.

    The override runs several replicas of the service, and each replica publishes every output.
    """
    for release in entry.releases if (entry.override.replicas or 0) > 1 else ():
        if isinstance(release, ServiceRelease):
            service = release.service
            is_doubled = service.outputs and not service.scaling.divides_work
            # an override with a higher rank may set another number
            if is_doubled and most_replicas(release.replicas) == entry.override.replicas:
                yield service.name


def _releases(world: World) -> dict[str, list[Release]]:
    """Return a map from override to the releases that it changes or denies."""
    found = defaultdict[str, list[Release]](list)
    for key in all_keys(world):
        release = plan(world, key)
        if release is not None:
            for override, _ in release.shaping.by:
                found[override.name].append(release)
            continue
        stopped = denied_release(world, key)
        if stopped is not None:
            found[stopped[1].name].append(stopped[0])
    return found


def _claims(world: World) -> dict[str, list[Claim]]:
    """Return a map from the name of an override to the claims on which the override acts.

    An override with ``deny`` acts on the claims that it suspends. An override with ``keep`` acts on
    the claims that it selects.
    """
    found = defaultdict[str, list[Claim]](list)
    for claim in sorted(world.ledger, key=lambda one: (str(one.subject), one.demand)):
        by = [suspended_by(claim, world), *claim_overrides.keeping_overrides(claim, world)]
        for name in {override.name for override in by if override is not None}:
            found[name].append(claim)
    return found
