"""A restoration books the claims of an earlier commit again.

A restoration undoes newer claims only if the request says so. A restored lease runs for its full
term from now on, because its old end may have passed. After a restoration, as after every change,
:mod:`demandops.plan.overrides.claim_overrides` updates the claims that overrides keep.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.demand import admission, permission
from demandops.demand.claim import Claim
from demandops.demand.demand_request import Demanded, DemandRequest, Put
from demandops.demand.lease import Lease, Term
from demandops.errors import Fault, Refused, fault
from demandops.ledger.claim_changes import Changes, ClaimChange, claim_changes
from demandops.ledger.claim_file import path_of
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World

_SHOWN = 20


@dataclass(frozen=True, slots=True)
class Restoration(DemandRequest):
    """A request to restore the ledger of an earlier commit.

    ``to`` is the earlier commit, ``made`` is its time, and ``claims`` are the claims of its ledger.
    ``drop_newer`` says that newer claims are undone. ``by`` and ``email`` name the person who
    requests the restoration.
    """

    to: str = ""
    made: datetime | None = None
    claims: tuple[Claim, ...] = ()
    drop_newer: bool = False
    reason: str = ""
    by: str = ""
    email: str = ""

    operation = "rollback"


def restore(ledger: Ledger, request: Restoration, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger with the claims of the earlier commit, and the changes.

    A restored claim gets its whole lease from ``now``.

    Raises:
        Refused: if the restoration drops or changes a claim of the present ledger, and
            ``drop_newer`` is not set. Claims that overrides keep, and renewals, do not count.
    """
    changes = _changes(ledger, request)
    if not request.drop_newer:
        newer = [c for c in changes if c.before is not None and c.before.keeping_override is None]
        if newer:
            raise Refused(_newer_faults(newer))
    start = ledger
    for change in changes:
        ledger = ledger.replace(change.key, _with_full_lease(change, now))
    booked = {who for change in changes if change.after for who in change.after.requesters}
    shutdowns, forgotten = start.shutdowns.forget(now, booked)
    return replace(ledger, shutdowns=shutdowns), Changes(
        claims=claim_changes(start, ledger, [change.key for change in changes]),
        shutdowns=forgotten,
    )


def _changes(ledger: Ledger, request: Restoration) -> list[ClaimChange]:
    """Return the changes of claims that restore the earlier commit, sorted by path.

    A claim stays as it is if the earlier claim differs only in the length or the end of the lease.
    """
    restored = {claim.key: claim for claim in request.claims}
    gone = [ClaimChange(claim, None) for claim in ledger if claim.key not in restored]
    back = [ClaimChange(ledger.get(key), claim) for key, claim in restored.items()]
    back = [change for change in back if not _same(change.before, change.after)]
    return sorted([*gone, *back], key=lambda change: path_of(change.key))


def _same(one: Claim | None, other: Claim | None) -> bool:
    if one is None or other is None:
        return one is other
    if one.keeping_override is not None:  # the booking time of a kept claim does not matter
        one = replace(one, booked=other.booked)
    return replace(one, lease=other.lease) == other and bool(one.lease) == bool(other.lease)


def _with_full_lease(change: ClaimChange, now: datetime) -> Claim | None:
    claim = change.after
    if claim is None or claim.lease is None:
        return claim
    term = Term(claim.lease.seconds, claim.lease.slack)
    lease: Lease = term.lease_from(now)
    return replace(claim, lease=lease)


def _newer_faults(changes: list[ClaimChange]) -> Iterator[Fault]:
    for change in changes[:_SHOWN]:
        claim = change.before
        assert claim is not None  # noqa: S101 - the caller passes existing claims
        effect = "drop" if change.after is None else "undo a change of"
        message = (
            f"would {effect} the claim of {', '.join(claim.requesters)} on {claim.subject}, booked "
            f"{claim.booked:%Y-%m-%d %H:%M:%S} UTC (request '{claim.request}')"
        )
        yield fault("", message, code="newer").within(path_of(claim.key))
    more = len(changes) - _SHOWN
    others = f"{more} more {'claims' if more > 1 else 'claim'} would change; " if more > 0 else ""
    message = f"{others}claims that were booked or changed since are undone only with --drop-newer"
    yield fault("", message, code="newer")


def faults(request: Restoration, world: World) -> Iterator[Fault]:
    """Yield the faults of claims that the restoration changes or books.

    There is a fault if the current configuration does not allow the claim. Claims that overrides
    keep are not checked.
    """
    for change in _changes(world.ledger, request):
        after = change.after
        if after is None or after.keeping_override is not None:
            continue
        booking = request_for(after)
        for found in (
            *admission.faults(booking, world.config),
            *permission.faults(booking, world.config),
        ):
            yield found.within(path_of(change.key))


def request_for(claim: Claim) -> Put:
    """Return a request that books this claim; its faults are located at fields of the claim."""
    return Put(
        id=claim.request,
        demanded=(Demanded(claim.held, claim.requesters, str),),
        demand=claim.demand,
        lease_s=claim.lease.seconds if claim.lease else None,
    )
