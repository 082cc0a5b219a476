"""The state of an override, which is in force only once the files that it changes are written."""

from __future__ import annotations

from collections.abc import Collection

from demandops.ledger.world import World
from demandops.plan.views.override_report import Entry, State, affected_releases
from demandops.render.gitops.paths import path_of


def override_state(entry: Entry, world: World, not_rendered: Collection[str]) -> State:
    """Return the state of an override; ``not_rendered`` are paths of files."""
    if entry.state != "in force" or not not_rendered:
        return entry.state
    paths = {path_of(release) for release in affected_releases(entry, world)}
    return "not rendered yet" if paths & {*not_rendered} else entry.state
