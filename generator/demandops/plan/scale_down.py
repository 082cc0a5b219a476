"""When a service gets fewer replicas: at once, or after the time in the service's definition.

If the definition has such a time and demands need fewer replicas than before, the decision records
how many replicas the service keeps, and until when (:mod:`demandops.ledger.kept_replicas`). When
that time is over, the generator publishes a commit that removes these replicas from the record.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime

from demandops.errors import Refused
from demandops.ledger.kept_replicas import Instance, Steps, extended
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World
from demandops.plan.planner import without_kept
from demandops.plan.release import ServiceKey, ServiceRelease
from demandops.plan.release_keys import ReleaseKey


def with_kept_replicas(
    before: World, after: World, keys: Iterable[ReleaseKey], now: datetime
) -> tuple[Ledger, tuple[Instance, ...]]:
    """Return the updated ledger, and the service instances whose kept replicas changed.

    ``keys`` are the keys of the releases that the demand may change.
    """
    kept, changed = after.ledger.kept, list[Instance]()
    for key in keys:
        if not isinstance(key, ServiceKey):
            continue
        recorded = kept.steps.get(key.instance) or ()
        if not recorded and key.service not in after.config.services_with_down_after:
            continue
        steps = _steps(before, after, key, recorded, now)
        if steps != recorded:
            kept = kept.replace(key.instance, steps)
            changed.append(key.instance)
    return replace(after.ledger, kept=kept) if changed else after.ledger, tuple(changed)


def _steps(before: World, after: World, key: ServiceKey, recorded: Steps, now: datetime) -> Steps:
    release = without_kept(after, key)
    kept_for = release.service.scaling.kept_for if release else None
    if release is None or kept_for is None:
        return ()  # a service that nobody needs stops at once, as does one without ``downAfter``
    try:
        old = without_kept(before, key)
    except Refused:  # the release before the demand can no longer be planned
        old = None
    return extended(recorded, _number(release), _number(old), now, now + kept_for)


def _number(release: ServiceRelease | None) -> int:
    return release.replicas if release and isinstance(release.replicas, int) else 0


def without_ended(world: World, instance: Instance, now: datetime) -> Ledger:
    kept = world.ledger.kept
    steps = tuple(step for step in kept.steps.get(instance) or () if step.until > now)
    return replace(world.ledger, kept=kept.replace(instance, steps))
