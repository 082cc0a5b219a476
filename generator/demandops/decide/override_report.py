"""What each override does now, for ``get overrides``, `check` and the page."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Literal

from demandops.decide.planning import overrides
from demandops.decide.planning.overrides import suspended_by
from demandops.decide.planning.planner import all_keys, denied_release, keys_of_claims, plan
from demandops.model.config.override import Override, format_time
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import World
from demandops.model.release import Release, ServiceRelease, most_replicas
from demandops.render.gitops import path_of

# ``matches nothing``: the override selects nothing, or its effects do not apply to what it selects.
# ``held back``: another override with ``hold`` keeps every file that this override would change.
# ``not rendered yet``: a generator has not written the changed files yet.
State = Literal["in force", "held back", "expired", "matches nothing", "not rendered yet"]


@dataclass(frozen=True, slots=True)
class Entry:
    override: Override
    state: State
    releases: tuple[Release, ...]
    claims: tuple[Claim, ...]


def override_report(world: World, now: datetime) -> list[Entry]:
    if not world.config.overrides:
        return []
    releases = defaultdict[str, list[Release]](list)
    for key in all_keys(world):
        if (release := plan(world, key)) is not None:
            for override, _ in release.shaping.by:
                releases[override.name].append(release)
        elif denied := denied_release(world, key):
            releases[denied[1].name].append(denied[0])
    claims = defaultdict[str, list[Claim]](list)
    for claim in sorted(world.ledger, key=lambda claim: (str(claim.subject), claim.demand)):
        acting = [suspended_by(claim, world), *overrides.keeping_overrides(claim, world)]
        for name in {override.name for override in acting if override is not None}:
            claims[name].append(claim)
    entries = []
    for name, override in sorted(world.config.overrides.items()):
        changed = tuple(sorted(releases[name], key=lambda release: release.name))
        held = tuple(claims[name])
        state: State = "matches nothing"
        if changed or held or override.refuseNew:
            state = "in force" if held or override.refuseNew else "held back"
            for release in changed:
                own = next(
                    (effects for each, effects in release.shaping.by if each == override), ()
                )
                # only another override with ``hold`` keeps this one from changing the release
                if not release.shaping.held or "hold" in own or {*own} == {"keep"}:
                    state = "in force"
        if (override.end is not None and override.end <= now) or override not in world.overrides:
            state, changed, held = "expired", (), ()
        entries.append(Entry(override, state, changed, held))
    return entries


def affected_releases(entry: Entry, world: World) -> list[Release]:
    """Return the releases that an override changes, denies, or stops by suspending claims."""
    others = {name: each for name, each in world.config.overrides.items() if each != entry.override}
    without = World(replace(world.config, overrides=others), world.ledger)
    running = {*all_keys(world)} if entry.claims else set()
    by_name = {release.name: release for release in entry.releases}
    for key in keys_of_claims(without, entry.claims):
        if key not in running and (stopped := plan(without, key)):
            by_name[stopped.name] = stopped
    return [by_name[name] for name in sorted(by_name)]


_WITHOUT_EFFECT = {
    "matches nothing": "has no effect now, because its field 'select' matches nothing, or nothing "
    "to which its effects apply; if it should have an effect, correct it",
    "held back": "changes nothing, because another override with 'hold' keeps the same files as "
    "they are; remove one of the two overrides, or give this one a higher priority",
}


def warnings(entries: list[Entry]) -> Iterator[tuple[str, str]]:
    """Yield (file, warning) for each override without effect, or whose replicas repeat outputs."""
    for entry in entries:
        override = entry.override
        if entry.state == "expired" and override.end:
            yield (
                override.path,
                f"expired at {format_time(override.end)}; remove the file, or write a later time",
            )
        elif entry.state in _WITHOUT_EFFECT:
            yield override.path, _WITHOUT_EFFECT[entry.state]
        elif (override.replicas or 0) > 1:
            # An override with a higher rank may set another number. Several replicas are a warning
            # and no fault, because a person may have pinned an image that divides its work.
            repeated = {
                release.service.name
                for release in entry.releases
                if isinstance(release, ServiceRelease)
                and release.service.outputs
                and not release.service.scaling.divides_work
                and most_replicas(release.replicas) == override.replicas
            }
            if repeated:
                yield (
                    override.path,
                    f"runs {override.replicas} replicas of {' and '.join(sorted(repeated))}, and "
                    "each replica publishes every output; run only one, or set dividesWork: true "
                    "in 'scaling' of the service's definition if the program divides its work "
                    "among replicas",
                )


def override_state(entry: Entry, world: World, not_rendered: Collection[str]) -> State:
    # An override is in force only once the files that it changes are written.
    if entry.state != "in force" or not not_rendered:
        return entry.state
    paths = {path_of(release) for release in affected_releases(entry, world)}
    return "not rendered yet" if paths & {*not_rendered} else entry.state
