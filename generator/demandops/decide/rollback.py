"""A restoration books the claims of an earlier commit again.

A restoration undoes newer claims only if the request says so. Afterwards, as after every change,
:mod:`.overrides` updates the claims that overrides keep.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.base.errors import Fault, Refused, fault
from demandops.decide.admission import admission, permission
from demandops.model.demand.demand import Demand, Item, Rollback
from demandops.model.ledger.claim import Claim, path_of
from demandops.model.ledger.ledger import Changes, ClaimChange, Ledger, World, claim_changes

_SHOWN = 20


@dataclass(frozen=True, slots=True)
class Restoration(Rollback):
    """A rollback with the claims of the commit ``to``, which was made at ``made``."""

    is_complete: bool = True
    made: datetime | None = None
    claims: tuple[Claim, ...] = ()


def restore(ledger: Ledger, request: Restoration, now: datetime) -> tuple[Ledger, Changes]:
    """Restore the claims; raise Refused if newer ones would change without ``drop_newer``."""
    changes = _changes(ledger, request)
    # claims that overrides keep do not count, because they are made again
    newer = [(c, c.before) for c in changes if c.before and c.before.keeping_override is None]
    if newer and not request.drop_newer:
        refusals: list[Fault] = []
        for change, claim in newer[:_SHOWN]:
            effect = "drop" if change.after is None else "undo a change of"
            message = (
                f"would {effect} the claim of {', '.join(claim.requesters)} on {claim.subject}, "
                f"booked {claim.booked:%Y-%m-%d %H:%M:%S} UTC (request '{claim.request}')"
            )
            refusals.append(fault("", message, code="newer").within(path_of(claim.key)))
        more = len(newer) - _SHOWN
        what = f"{more} more {'claims' if more > 1 else 'claim'} would change; " if more > 0 else ""
        message = (
            f"{what}claims that were booked or changed since are undone only with --drop-newer"
        )
        raise Refused([*refusals, fault("", message, code="newer")])
    start = ledger
    for change in changes:
        restored = change.after
        if restored and restored.lease:  # from now on, because its old end may have passed
            restored = replace(restored, lease=restored.lease.started(now))
        ledger = ledger.replace(change.key, restored)
    keys = [change.key for change in changes]
    return ledger, Changes(claims=claim_changes(start, ledger, keys))


def _changes(ledger: Ledger, request: Restoration) -> list[ClaimChange]:
    earlier = {claim.key: claim for claim in request.claims}
    changes = [ClaimChange(claim, None) for claim in ledger if claim.key not in earlier]
    for key, claim in earlier.items():
        current = ledger.get(key)
        if current is not None:
            # a renewal is no change, and neither is a claim that an override kept at another time
            is_kept = current.keeping_override is not None
            booked = claim.booked if is_kept else current.booked
            same_lease = bool(current.lease) == bool(claim.lease)
            if same_lease and replace(current, booked=booked, lease=claim.lease) == claim:
                continue
        changes.append(ClaimChange(current, claim))
    return sorted(changes, key=lambda change: path_of(change.key))


def faults(request: Restoration, world: World) -> Iterator[Fault]:
    for change in _changes(world.ledger, request):
        after = change.after
        if after is None or after.keeping_override is not None:
            continue
        booking, config = request_for(after), world.config
        for each in (*admission.faults(booking, config), *permission.faults(booking, config)):
            yield each.within(path_of(change.key))


def request_for(claim: Claim) -> Demand:
    """Return a request that books this claim; its faults name fields of the claim."""
    return Demand(
        "put",
        id=claim.request,
        demanded=(Item(claim.held, claim.requesters),),
        demand=claim.demand,
        lease_s=claim.lease.seconds if claim.lease else None,
    )
