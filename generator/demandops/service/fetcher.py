"""Fetches what others push to the state repo while no demand comes, and commits what follows.

Everything but :meth:`Fetcher.fetch_now` and ``Fetcher.remote`` belongs to the worker thread.
Demands go first: a fetch stops when a demand arrives, because its push shows what is new too.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

from demandops.errors import Fault, StateRepoError
from demandops.service.demand_queue import DemandQueue
from demandops.service.remote_status import RemoteMonitor
from demandops.service.timing.polling import PollTimer
from demandops.staterepo.git.repository import FetchInterrupted, StateRepository
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write import commit_batch

log = logging.getLogger("demandops")

_TRIES = 5
_LONGEST_PAUSE_S = 0.05


class Fetcher:
    """Fetches at an interval and on request, and carries out people's changes."""

    def __init__(
        self,
        repository: StateRepository,
        queue: DemandQueue,
        fetch_interval: float,
        new_commit_batch: Callable[[], commit_batch.CommitBatch],
        on_published: Callable[[commit_batch.CommitBatch], None],
    ) -> None:
        """Plan the first fetch.

        Args:
            repository: the state repo.
            queue: the demands, which go first.
            fetch_interval: seconds between two fetches; 0: only on request.
            new_commit_batch: returns a commit batch on the newest tip, with the commits that carry
                out people's changes.
            on_published: called with each commit batch after it was published.
        """
        self._repository = repository
        self._queue = queue
        self._new_commit_batch, self._on_published = new_commit_batch, on_published
        self._timer = PollTimer(
            fetch_interval, repository.runtime, embedded=repository.always_current
        )
        self._logged: frozenset[Fault] = frozenset()
        self._stopped = repository.runtime.event()
        self.remote = RemoteMonitor(repository.address, repository.runtime)

    def fetch_now(self) -> None:
        """Make a fetch due now; from any thread."""
        self._timer.request()
        self._queue.wake()

    def stop_retrying(self) -> None:
        """Let pending attempts be the last; from any thread."""
        self._stopped.set()

    def seconds_until_due(self) -> float | None:
        """Return the seconds until the next fetch, or None if none is planned."""
        return self._timer.seconds_until_due()

    def fetch_if_due(self, known: Snapshot, due: bool) -> bool:
        """Fetch if it is time to, and carry out what others pushed.

        A repository on this disk is read each time, because that is cheap.

        Args:
            known: the newest state that was read.
            due: whether there is something to commit although nobody pushed.

        Returns:
            False if the state repo could not be reached.
        """
        try:
            if self._timer.start_if_due():
                self._repository.refresh_unless_urgent(lambda: self._queue.must_not_wait)
            elif not (self._repository.always_current or due):
                return True
            new = due or self._repository.tip() != known.commit
            self.record_reached(pushed=new and self._carry_out_changes())
        except FetchInterrupted:
            self._timer.interrupted()
        except StateRepoError as error:
            self.record_unreachable(error)
            return False
        return True

    def carry_out_changes(self) -> None:
        """Carry out people's changes up to the last fetched tip; does not fetch."""
        try:
            self._carry_out_changes()
        except StateRepoError as error:
            self.record_unreachable(error)

    def _carry_out_changes(self) -> bool:
        """Commit and publish what follows from people's changes; return whether it committed."""
        for _ in range(_TRIES):
            commits = self._new_commit_batch()
            if commits.publish():
                self._on_published(commits)
                return commits.head.commit != commits.start.commit
            self._repository.refresh()
            self._stopped.wait(self._repository.runtime.uniform(0, _LONGEST_PAUSE_S))
        return False  # other generators are faster, and they carry out the same changes

    def record_reached(self, *, pushed: bool) -> None:
        """Record that the state repo was reached."""
        self._queue.blocked = ""
        self.remote.record_reached(pushed=pushed)
        self._timer.finished(reached=True)

    def record_unreachable(self, error: StateRepoError) -> None:
        """Record that the state repo cannot be reached or written."""
        if self._stopped.is_set():  # there is no retry to report
            return
        self._queue.blocked = str(error)
        self.remote.record_unreachable(str(error))
        self._timer.finished(reached=False)

    def log_problems(self, problems: Iterable[Fault]) -> None:
        """Log each fault once, and each file once that is valid again."""
        current = list(dict.fromkeys(problems))
        for problem in current:
            if problem not in self._logged:
                log.error("%s (its last valid version stays in effect)", problem)
        for file in sorted({old.file for old in self._logged} - {new.file for new in current}):
            log.info("%s is valid again", file or "the state repo")
        self._logged = frozenset(current)
