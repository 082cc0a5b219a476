"""What follows from people's changes: of claims in the ledger, and of overrides."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from itertools import chain

from demandops.base.errors import Fault, Refused
from demandops.base.naming import Subject
from demandops.decide.admission import admission, permission
from demandops.decide.booking import request_for
from demandops.decide.checks import collisions, forbidden
from demandops.decide.placement.relocation import LedgerUpdate, following_overrides
from demandops.decide.planning import overrides
from demandops.decide.planning.planner import affected_keys, keys_of_claims
from demandops.decide.state import Changeset, FileReader, State, plan_change, render_change
from demandops.model.config.override import Override, format_time
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.claim import ClaimKey
from demandops.model.ledger.ledger import (
    Changes,
    ClaimChange,
    Ledger,
    World,
    changes_on,
    claim_changes,
)

# ---- claims that a person edits: what changes with them, and what is wrong with them ----


def changeset_of_edit(
    state: State, before: Ledger, subjects: Iterable[Subject], read: FileReader
) -> Changeset:
    old = replace(state, ledger=before)
    keys = affected_keys(old, state, changes_on(before, state.ledger, subjects))
    planned = plan_change(old, state, Changes(), keys, read)
    # a template that takes too long is no fault of the claim, so its release keeps its file
    return render_change(planned, state.config, state.evaluate, read, keeps_late=True)


def faults_of_edit(before: World, after: State, changes: Iterable[ClaimChange]) -> Iterator[Fault]:
    """Yield the faults of claims that a person wrote, each located in the claim's file."""
    for change in changes:
        claim = change.after
        if claim is None:
            continue
        # an edit that only takes requesters away has the effect of a release, which is allowed
        if (
            (old := change.before)
            and replace(claim, requesters=old.requesters) == old
            and {*claim.requesters} <= {*old.requesters}
        ):
            continue
        wanted, config = request_for(claim), after.config
        malformed = list(admission.faults(wanted, config))
        allowed = chain(
            permission.faults(wanted, config),
            forbidden.quota_faults(before, after, Changes((change,))),
        )
        for each in malformed or allowed:
            yield each.within(claim_files.path_of(claim.key))
        yield from collisions.faults_of_claim(claim, before, after, after.names)
        keys, changed = keys_of_claims(after, [claim]), Changes((change,))
        faults = list(collisions.name_faults(wanted, before, after, keys, changed, after.names))
        without = replace(after, ledger=after.ledger.replace(change.key, change.before))
        with suppress(Refused):  # other checks report a claim that cannot be planned
            grown = forbidden.growth_by(without, after, [change])
            # only growth is a fault: the nodes may be full because of other claims
            usage = after.usage.plus({need: -amount for need, amount in grown.items()})
            faults += forbidden.NoRoom(usage, grown, config).faults
        for each in faults:
            yield each.within(claim_files.path_of(claim.key))


# ---- changes to the ledger when overrides change or end: kept claims, moved services, markers ----
#
# A marker is a file of the ledger that records that an override has ended. When an override in
# effect reaches its end, the generator publishes a commit with the marker. Until then the override
# stays in effect, so what runs depends on files alone and not on a clock.


def update_ledger(
    before: World,
    after: World,
    subjects: Iterable[Subject],
    markers: Mapping[str, str],
    now: datetime,
    *,
    ending: Iterable[Override] = (),
) -> LedgerUpdate:
    """Return the ledger that a change of the configuration requires, and the files to write.

    ``subjects`` are those whose claims a person changed. ``markers`` are the ledger's markers of
    ended overrides, by path. ``ending`` are overrides whose end the generator commits now.
    """
    # An override that is merged after its end never applies. One that was in effect before stays
    # in effect until the generator's own commit ends it.
    in_effect = {override.name: override.end for override in before.overrides}
    expired = [
        *ending,
        *(
            override
            for override in expired_overrides(after, now)
            if override.name not in in_effect or in_effect[override.name] != override.end
        ),
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
        path = records.ended_override_path(override.name)
        files[path] = records.ended_override_text(override)
    after = replace(after, ledger=replace(after.ledger, ended=ended))
    kept = [c.subject for ledger in (before.ledger, after.ledger) for c in ledger.kept_claims()]
    subjects = dict.fromkeys((*subjects, *kept))
    update = update_claims(before.ledger, after, subjects, now, moves_all=True)
    return replace(update, files={**files, **update.files})


def update_claims(
    before: Ledger,
    after: World,
    subjects: Iterable[Subject],
    now: datetime,
    *,
    moves_all: bool = False,  # and not only those of ``subjects``
) -> LedgerUpdate:
    subjects = tuple(subjects)
    ledger, kept = overrides.update_kept_claims(before, after, subjects, now)
    moved = following_overrides(replace(after, ledger=ledger), None if moves_all else subjects)
    keys = (*kept, *moved.keys)
    files = changed_claim_files(after.ledger, moved.ledger, keys)
    return replace(moved, keys=keys, files=files)


def changed_claim_files(
    before: Ledger, after: Ledger, keys: Iterable[ClaimKey]
) -> dict[str, str | None]:
    """Return the new texts of the files of changed claims, by path; ``None`` removes a file."""
    return {
        claim_files.path_of(change.key): claim_files.text_of(change.after) if change.after else None
        for change in claim_changes(before, after, keys)
    }


def expired_overrides(world: World, now: datetime) -> list[Override]:
    """Return the overrides in effect although their end has passed, sorted by end."""
    ends = [(each.end, each.name, each) for each in world.overrides if each.end]
    expired = [each for each in ends if each[0] <= now]
    return [override for _, _, override in sorted(expired, key=lambda each: each[:2])]


def changed_override_files(before: World, after: World) -> list[str]:
    old = {override.name: override for override in before.overrides}
    new = {override.name: override for override in after.overrides}
    names = [name for name in {*old, *new} if old.get(name) != new.get(name)]
    return sorted((new.get(name) or old[name]).path for name in names)
