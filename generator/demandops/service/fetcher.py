"""Following the state repo: what others publish there is taken in while no demand comes.

Belongs to the worker thread, but for :meth:`Follower.nudge` and what it tells of its link. Demands
go first: a look gives way to them, for their own push shows what is new as well.
"""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Callable, Iterable

from demandops.errors import Fault, StateRepoError
from demandops.service.demand_queue import DemandQueue
from demandops.service.remote_status import Link
from demandops.service.timing.polling import PollTimer
from demandops.staterepo.git.repository import CutShort, StateRepository
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.write import commit_line

log = logging.getLogger("demandops")

_TRIES = 5
_LONGEST_PAUSE_S = 0.05


class Follower:
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
        self._waiting = waiting
        self._line, self._taken = line, taken
        self._looks = PollTimer(fetch_interval, embedded=repository.always_current)
        self._logged: frozenset[Fault] = frozenset()
        self._given_up = threading.Event()
        self.link = Link(repository.address)

    def nudge(self) -> None:
        """Have the state repo looked at now; from any thread."""
        self._looks.nudge()
        self._waiting.wake()

    def give_up(self) -> None:
        """Try nothing again; from any thread."""
        self._given_up.set()

    def pause(self) -> float | None:
        """Return the seconds until the next look is due; nothing: none is."""
        return self._looks.pause()

    def notice(self, known: Snapshot, due: bool) -> bool:
        """Take in what others published, where it is time to look or it costs nothing.

        Args:
            known: what was taken in last.
            due: whether there is something to commit although nobody published anything.

        Returns:
            Whether the state repo was reached, or need not be.
        """
        try:
            if self._looks.begin():
                self._repository.look(lambda: self._waiting.urgent)
            elif not (self._repository.always_current or due):
                return True
            new = due or self._repository.tip() != known.commit
            self.in_touch(pushed=new and self._take_in())
        except CutShort:
            self._looks.again()
        except StateRepoError as error:
            self.out_of_touch(error)
            return False
        return True

    def catch_up(self) -> None:
        """Try again what people changed and could not be carried out: a release may allow it."""
        try:
            self._take_in()
        except StateRepoError as error:
            self.out_of_touch(error)

    def _take_in(self) -> bool:
        """Bring the snapshot to the newest tip, and publish what follows from people's changes.

        Returns:
            Whether there was something to publish.
        """
        for _ in range(_TRIES):
            line = self._line()
            if line.publish():
                self._taken(line)
                return line.head.commit != line.start.commit
            self._repository.refresh()
            self._given_up.wait(random.uniform(0, _LONGEST_PAUSE_S))  # noqa: S311 - no secret
        return False  # others are quicker, and follow people's changes as this generator would

    def in_touch(self, *, pushed: bool) -> None:
        """Note that the state repo was reached."""
        self._waiting.blocked = ""
        self.link.reached(pushed=pushed)
        self._looks.done(reached=True)

    def out_of_touch(self, error: StateRepoError) -> None:
        """Note that the state repo could not be reached, or takes nothing."""
        if self._given_up.is_set():  # nobody tries again, so it is no news
            return
        self._waiting.blocked = str(error)
        self.link.lost(str(error))
        self._looks.done(reached=False)

    def tell(self, problems: Iterable[Fault]) -> None:
        """Log what is not valid, and what is again, once each."""
        found = list(dict.fromkeys(problems))
        for one in found:
            if one not in self._logged:
                log.error("%s (its last valid version stays in force)", one)
        for file in sorted({one.file for one in self._logged} - {one.file for one in found}):
            log.info("%s: what was not valid is mended", file or "the state repo")
        self._logged = frozenset(found)
