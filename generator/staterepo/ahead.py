"""Reading on while a line is laid again: of a tip that keeps moving, only the rest is read."""

from __future__ import annotations

from pygit2 import Oid, Repository

from generator.staterepo import snapshot as snapshots
from generator.staterepo.snapshot import Advance, Snapshot


class Ahead:
    """What was read behind the published snapshot, and could not be built on yet.

    With writers that are faster, each try would read more than the one before, and be too late.
    """

    def __init__(self) -> None:
        self._known: Advance | None = None
        self._start: Oid | None = None

    def advance(self, repo: Repository, before: Snapshot, tip: Oid) -> Advance:
        """Return what differs between ``before`` and ``tip``."""
        known = self._known
        if known is None or self._start != before.commit:
            known = Advance(before, (), False)
        if known.snapshot.commit != tip or known.snapshot.problems:
            known = known.then(snapshots.advance(repo, known.snapshot, tip))
        self._known, self._start = known, before.commit
        return known
