"""What a request changes in the ledger: claims, before and after the change, and other records."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from demandops.demand.claim import Claim, ClaimKey
from demandops.ledger.kept_replicas import Instance
from demandops.ledger.ledger import Ledger
from demandops.ledger.recent_shutdowns import RecentShutdown
from demandops.subject import Subject


@dataclass(frozen=True, slots=True)
class ClaimChange:
    """One claim before and after a change: it is new without ``before``, released without
    ``after``.
    """

    before: Claim | None
    after: Claim | None

    @property
    def key(self) -> ClaimKey:
        claim = self.after or self.before
        assert claim is not None  # noqa: S101 - a change has at least one side
        return claim.key

    @property
    def only_renews(self) -> bool:
        """Whether the claim existed before and at most its lease changed."""
        before, after = self.before, self.after
        return bool(before and after and replace(after, lease=before.lease) == before)


@dataclass(frozen=True, slots=True)
class Changes:
    """What a request changed in the ledger."""

    claims: tuple[ClaimChange, ...] = ()
    # in words, what a shutdown lists, but its requesters do not hold
    not_held: tuple[str, ...] = ()
    # the digests of shutdowns that the ledger now records or forgets
    shutdowns: tuple[str, ...] = ()
    # the earlier shutdown that the request repeats
    repeats: RecentShutdown | None = None
    # the service instances whose kept replicas changed
    kept: tuple[Instance, ...] = ()
    # the ids of the demands that begin or cease to wait, or that now wait with another goal
    waiting: tuple[str, ...] = ()

    def subjects(self) -> tuple[Subject, ...]:
        return tuple(dict.fromkeys(change.key.subject for change in self.claims))


def changes_on(
    before: Ledger, after: Ledger, subjects: Iterable[Subject]
) -> tuple[ClaimChange, ...]:
    keys = (
        claim.key
        for subject in subjects
        for ledger in (before, after)
        for claim in ledger.claims_on(subject)
    )
    return claim_changes(before, after, keys)


def claim_changes(
    before: Ledger, after: Ledger, keys: Iterable[ClaimKey]
) -> tuple[ClaimChange, ...]:
    """Return the claims at ``keys`` that differ between two ledgers."""
    changes = (ClaimChange(before.get(key), after.get(key)) for key in dict.fromkeys(keys))
    return tuple(change for change in changes if change.before != change.after)
