"""Settling: a batch of demands is judged, committed and published, however often the remote moves.

Belongs to one thread, the only one that writes to the state repo.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from datetime import datetime, timezone

from demandops.config.config import Config
from demandops.errors import ShuttingDown
from demandops.service.approvals.approvals import Approvals, Deferred
from demandops.service.demand_queue import DemandQueue
from demandops.service.evaluation import Evaluator, Result
from demandops.service.fetcher import Follower
from demandops.service.ticket import Receipt, Ticket
from demandops.service.timing.backoff import LIMIT_EMBEDDED, LIMIT_REMOTE, Backoff
from demandops.service.timing.lease_expiry import LONGEST_WAIT_S, Expiries
from demandops.service.timing.override_expiry import OverrideClock
from demandops.staterepo.git.repository import PushDenied, RemoteAway, StateRepository
from demandops.staterepo.load.snapshot import ReadAhead, Snapshot
from demandops.staterepo.write import commit_line

log = logging.getLogger("demandops")

_TIDY_EVERY = 300


class Worker:
    """Turns batches of demands into published commits.

    ``snapshot`` is the newest published state; it may be read from any thread.
    """

    def __init__(
        self,
        repository: StateRepository,
        snapshot: Snapshot,
        waiting: DemandQueue,
        on_published: Callable[[Config], None],
        with_targets: bool,
        approvals: Approvals,
        fetch_interval: float = 0.0,
    ) -> None:
        self.snapshot = snapshot
        self._approvals = approvals
        self._repository = repository
        self._waiting = waiting
        self._on_published = on_published
        self._judge = Evaluator(repository, waiting, approvals, with_targets)
        self._stale = False
        self._verdict_is_current = False
        self._since_tidy = 0
        self._expiries = Expiries()
        self._overrides = OverrideClock()
        self._ahead = ReadAhead()
        self._giving_up = threading.Event()
        embedded = repository.always_current
        self.follower = Follower(repository, waiting, fetch_interval, self._line, self._taken)
        self._batch_limit = LIMIT_EMBEDDED if embedded else LIMIT_REMOTE

    def give_up(self) -> None:
        """Stop waiting for a remote that is away; from any thread."""
        self._giving_up.set()
        self.follower.give_up()
        self._repository.give_up()
        self._waiting.wake()

    def take_up(self, batch: list[Ticket]) -> None:
        """Move what waits into ``batch``, and behind it the demands whose lease ran out.

        A renewal that waits was received before: it is judged first, or nothing expires yet.
        """
        self._take_up(batch)
        if not self._waiting.anything:
            batch += self._expiries.tickets(self.snapshot.state.ledger)

    def _take_up(self, batch: list[Ticket]) -> None:
        self._waiting.take_up(batch, self._batch_limit)
        self._approvals.resume(batch, self.snapshot.state)

    def settle(self, batch: list[Ticket]) -> None:
        """Bring a batch to an end, with what comes in while the remote moves, and empty it.

        Raises:
            ShuttingDown: where it was given up; the demands are still in the batch.
            DemandOpsError: where the state repo cannot be used; likewise.
        """
        self._stale, self._verdict_is_current = False, self._repository.always_current
        pace = Backoff(self._batch_limit)
        while batch:
            try:
                wait = self._tried(batch, pace)
            except RemoteAway as error:
                _doubt(batch, self.snapshot)
                self.follower.out_of_touch(error)
                self._verdict_is_current = self._repository.always_current
                wait = pace.away()
            if wait is None:
                continue
            # waited before the fetch: what is judged then is pushed while it is fresh
            self._linger(batch, wait)
            if self._giving_up.is_set():
                raise ShuttingDown(
                    "the remote is away; the demand stays in the outbox for the next start"
                )
            self._take_up(batch)

    def _tried(self, batch: list[Ticket], pace: Backoff) -> float | None:
        """Judge and publish a part of a batch; return how long to wait where that was in vain.

        Raises:
            RemoteAway: where the remote cannot be reached.
        """
        # of a remote that is away nothing is judged: what is committed stays in
        if self._stale or self.follower.link.is_away:
            self._repository.refresh()
            self._stale, self._verdict_is_current = False, True
        self._waiting.dismiss_withdrawn(batch)
        part = batch[: pace.share]
        self._approvals.give_up(part, self.snapshot.state)
        line = self._line()
        began = time.monotonic()
        arrived = self._judge.arrived(line.start, part)
        results: list[Result] = []
        for ticket in part:
            results.append((ticket, self._judge(line, ticket, arrived, results)))
        judged = time.monotonic()
        if line.head.commit == line.start.commit and not self._verdict_is_current:
            # only a push would have shown that the remote has moved
            tip = self._repository.refresh()
            self._verdict_is_current = True
            if tip != line.start.commit:
                return None
        if self._publish(line, results):
            self._answer(results)
            del batch[: len(part)]
            pace.published()
            return None
        log.info("the state repo has moved; judging %d demands again", len(part))
        _doubt(part, line.start)
        self._stale = True
        return pace.overtaken(len(part), judged - began, time.monotonic() - judged)

    def _answer(self, results: list[Result]) -> None:
        """Answer what is settled; what needs approval waits on."""
        told = [(ticket, result) for ticket, result in results if not isinstance(result, Deferred)]
        self._waiting.answer(told)
        for ticket, result in results:
            if isinstance(result, Deferred):
                self._approvals.take(ticket, result.decision)

    def attend(self) -> None:
        """Look after the demands that await approval, with main as it is now."""
        if not self._approvals.is_due(str(self.snapshot.commit)):
            return
        try:
            heads = self._approvals.heads()
            if heads.main != str(self.snapshot.commit):
                self._repository.refresh()
                self.follower.catch_up()
            # a branch that is gone may have been merged: only a newer main tells
            if self._repository.includes(str(self.snapshot.commit), heads.main):
                self._approvals.look(self.snapshot, heads)
        except (RemoteAway, PushDenied) as error:
            log.warning("%s; the demands that await approval wait on", error)

    def _linger(self, batch: list[Ticket], seconds: float) -> None:
        """Let a while pass; demands that come in meanwhile are kept, and told why they wait."""
        end = time.monotonic() + seconds
        told = list(batch)
        while not self._giving_up.is_set():
            if self.follower.link.is_away:
                for ticket in told:
                    ticket.tell("away", f"waiting: {self.follower.link.contact.trouble}")
            self._waiting.dismiss_withdrawn(batch)
            left = end - time.monotonic()
            if left <= 0:
                return
            told = self._waiting.keep(left)

    def pause(self) -> float:
        """Return the seconds until leases, overrides, proposals or the state repo are due."""
        state = self.snapshot.state
        ends = self._expiries.pause(state.ledger, self._approvals.pause(LONGEST_WAIT_S))
        ends = self._overrides.pause(state.config, _now(), ends)
        look = self.follower.pause()
        return ends if look is None else min(ends, look)

    def catch_up(self) -> None:
        """Try again what people changed and could not be carried out: a release may allow it."""
        if self.snapshot.problems:
            self.follower.catch_up()

    def notice(self) -> None:
        """Take in what others published, while no demand comes, and end overrides."""
        due = self._overrides.anything(self.snapshot.state.config, _now())
        if not self.follower.notice(self.snapshot, due):
            self._overrides.put_off(_now())

    def tidy(self) -> None:
        """Every few hundred commits: a demand leaves some twenty loose objects behind."""
        if self._since_tidy >= _TIDY_EVERY:
            self._since_tidy = 0
            self._repository.tidy()

    def _publish(self, line: commit_line.CommitLine, results: list[Result]) -> bool:
        """Publish a line; what the remote denies becomes the answer of all that is in it."""
        try:
            published = line.publish()
        except PushDenied as error:
            results[:] = [(t, error if isinstance(r, Receipt) else r) for t, r in results]
            self.follower.link.denied(str(error))
            return True
        if not published:
            return False
        self.follower.in_touch(pushed=line.head.commit != line.start.commit)
        self._taken(line)
        self._since_tidy += len(results)
        return True

    def _taken(self, line: commit_line.CommitLine) -> None:
        before, self.snapshot = self.snapshot, line.head
        if line.head.commit != before.commit:  # a merge may ask for no commit of our own
            self._on_published(line.head.state.config)

    def _line(self) -> commit_line.CommitLine:
        """Start a line on the newest tip that is known, people's changes taken in."""
        tip = self._repository.tip()
        before = self.snapshot
        if tip == before.commit and not before.problems:
            line = commit_line.CommitLine(self._repository, before)
            self._overrides.end(line, _now())
            return line
        advance = self._ahead.advance(self._repository.objects, before, tip)
        line = commit_line.CommitLine(self._repository, advance.snapshot)
        line.follow(advance, before, _now())
        self.follower.tell(line.head.problems)
        self._overrides.end(line, _now())
        return line


def _doubt(batch: list[Ticket], start: Snapshot) -> None:
    for ticket in batch:
        ticket.doubt(str(start.commit))


def _now() -> datetime:
    return datetime.now(timezone.utc)
