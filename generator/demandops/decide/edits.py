"""Claims that a person edits in the ledger: what changes with them, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import chain

from demandops.base.errors import Fault, Refused
from demandops.base.naming import Subject
from demandops.decide import changeset, rollback
from demandops.decide.admission import admission, permission
from demandops.decide.changeset import Changeset, FileReader
from demandops.decide.checks import collisions, quotas
from demandops.decide.placement import capacity
from demandops.decide.placement.capacity import NoRoom
from demandops.decide.planning.release_keys import affected_keys, keys_of_claims
from demandops.decide.state import State
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.ledger import Changes, ClaimChange, Ledger, World, changes_on


def changeset_of_edit(
    state: State, before: Ledger, subjects: Iterable[Subject], read: FileReader
) -> Changeset:
    old = replace(state, ledger=before)
    keys = affected_keys(old, state, changes_on(before, state.ledger, subjects))
    planned = changeset.plan_change(old, state, Changes(), keys, read)
    # a template that takes too long is no fault of the claim, so its release keeps its file
    return changeset.render_change(planned, state.config, state.evaluate, read, keeps_late=True)


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
        wanted, config = rollback.request_for(claim), after.config
        malformed = list(admission.faults(wanted, config))
        allowed = chain(
            permission.faults(wanted, config),
            quotas.quota_faults(before, after, Changes((change,))),
        )
        for each in malformed or allowed:
            yield each.within(claim_files.path_of(claim.key))
        yield from collisions.faults_of_claim(claim, before, after)
        keys, changed = keys_of_claims(after, [claim]), Changes((change,))
        faults = list(collisions.name_faults(wanted, before, after, keys, changed, after.names()))
        without = replace(after, ledger=after.ledger.replace(change.key, change.before))
        with suppress(Refused):  # other checks report a claim that cannot be planned
            grown = capacity.growth_by(without, after, [change])
            # only growth is a fault: the nodes may be full because of other claims
            usage = after.usage().plus({need: -amount for need, amount in grown.items()})
            faults += NoRoom(usage, grown, config).faults
        for each in faults:
            yield each.within(claim_files.path_of(claim.key))
