"""Following the state repo: what others publish there is taken in while no demand comes.

Belongs to the worker thread, but for :meth:`Fetcher.nudge` and what it tells of its link. Demands
go first: a look gives way to them, for their own push shows what is new as well.
"""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Callable, Iterable

from demandops.errors import Fault, StateRepoError
from demandops.service.demand_queue import DemandQueue
from demandops.service.remote_status import RemoteMonitor
from demandops.service.timing.polling import PollTimer
from demandops.staterepo.git.repository import CutShort, StateRepository
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write import commit_line

log = logging.getLogger("demandops")

_TRIES = 5
_LONGEST_PAUSE_S = 0.05


class Fetcher:
    """Looks at the state repo at an interval, and takes in what is new there."""

    def __init__(
        self,
        repository: StateRepository,
        waiting: DemandQueue,
        fetch_interval: float,
        line: Callable[[], commit_line.CommitLine],
        taken: Callable[[commit_line.CommitLine], None],
    ) -> None:
        """Make it.

        Args:
            repository: the state repo.
            waiting: the demands, which go first.
            fetch_interval: seconds between two looks; 0: none but of a repository on this disk.
            line: starts a line on the newest tip, with what follows from people's changes.
            taken: told of a line that is published.
        """
        self._repository = repository
        self._queue = waiting
        self._new_commit_line, self._on_published = line, taken
        self._timer = PollTimer(fetch_interval, embedded=repository.always_current)
        self._logged: frozenset[Fault] = frozenset()
        self._given_up = threading.Event()
        self.remote = RemoteMonitor(repository.address)

    def fetch_now(self) -> None:
        """Have the state repo looked at now; from any thread."""
        self._timer.request()
        self._queue.wake()

    def stop_retrying(self) -> None:
        """Try nothing again; from any thread."""
        self._given_up.set()

    def seconds_until_due(self) -> float | None:
        """Return the seconds until the next look is due; nothing: none is."""
        return self._timer.seconds_until_due()

    def fetch_if_due(self, known: Snapshot, due: bool) -> bool:
        """Take in what others published, where it is time to look or it costs nothing.

        Args:
            known: what was taken in last.
            due: whether there is something to commit although nobody published anything.

        Returns:
            Whether the state repo was reached, or need not be.
        """
        try:
            if self._timer.start_if_due():
                self._repository.look(lambda: self._queue.must_not_wait)
            elif not (self._repository.always_current or due):
                return True
            new = due or self._repository.tip() != known.commit
            self.record_reached(pushed=new and self._carry_out_changes())
        except CutShort:
            self._timer.interrupted()
        except StateRepoError as error:
            self.record_unreachable(error)
            return False
        return True

    def carry_out_changes(self) -> None:
        """Try again what people changed and could not be carried out: a release may allow it."""
        try:
            self._carry_out_changes()
        except StateRepoError as error:
            self.record_unreachable(error)

    def _carry_out_changes(self) -> bool:
        """Bring the snapshot to the newest tip, and publish what follows from people's changes.

        Returns:
            Whether there was something to publish.
        """
        for _ in range(_TRIES):
            line = self._new_commit_line()
            if line.publish():
                self._on_published(line)
                return line.head.commit != line.start.commit
            self._repository.refresh()
            self._given_up.wait(random.uniform(0, _LONGEST_PAUSE_S))  # noqa: S311 - no secret
        return False  # others are quicker, and follow people's changes as this generator would

    def record_reached(self, *, pushed: bool) -> None:
        """Note that the state repo was reached."""
        self._queue.blocked = ""
        self.remote.record_reached(pushed=pushed)
        self._timer.finished(reached=True)

    def record_unreachable(self, error: StateRepoError) -> None:
        """Note that the state repo could not be reached, or takes nothing."""
        if self._given_up.is_set():  # nobody tries again, so it is no news
            return
        self._queue.blocked = str(error)
        self.remote.record_unreachable(str(error))
        self._timer.finished(reached=False)

    def log_problems(self, problems: Iterable[Fault]) -> None:
        """Log what is not valid, and what is again, once each."""
        found = list(dict.fromkeys(problems))
        for one in found:
            if one not in self._logged:
                log.error("%s (its last valid version stays in force)", one)
        for file in sorted({one.file for one in self._logged} - {one.file for one in found}):
            log.info("%s: what was not valid is mended", file or "the state repo")
        self._logged = frozenset(found)
