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
from demandops.service.fetcher import Fetcher
from demandops.service.ticket import Receipt, Ticket
from demandops.service.timing.backoff import LIMIT_EMBEDDED, LIMIT_REMOTE, Backoff
from demandops.service.timing.lease_expiry import LONGEST_WAIT_S, LeaseExpiry
from demandops.service.timing.override_expiry import OverrideExpiry
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
        self._queue = waiting
        self._on_published = on_published
        self._evaluator = Evaluator(repository, waiting, approvals, with_targets)
        self._must_fetch = False
        self._tip_is_fresh = False
        self._commits_since_tidy = 0
        self._lease_expiry = LeaseExpiry()
        self._override_expiry = OverrideExpiry()
        self._ahead = ReadAhead()
        self._stopped_retrying = threading.Event()
        embedded = repository.always_current
        self.fetcher = Fetcher(
            repository, waiting, fetch_interval, self._new_commit_line, self._set_snapshot
        )
        self._batch_limit = LIMIT_EMBEDDED if embedded else LIMIT_REMOTE

    def stop_retrying(self) -> None:
        """Stop waiting for a remote that is away; from any thread."""
        self._stopped_retrying.set()
        self.fetcher.stop_retrying()
        self._repository.give_up()
        self._queue.wake()

    def take(self, batch: list[Ticket]) -> None:
        """Move what waits into ``batch``, and behind it the demands whose lease ran out.

        A renewal that waits was received before: it is judged first, or nothing expires yet.
        """
        self._take(batch)
        if not self._queue.has_waiting:
            batch += self._lease_expiry.tickets(self.snapshot.state.ledger)

    def _take(self, batch: list[Ticket]) -> None:
        self._queue.take(batch, self._batch_limit)
        self._approvals.resume(batch, self.snapshot.state)

    def publish(self, batch: list[Ticket]) -> None:
        """Bring a batch to an end, with what comes in while the remote moves, and empty it.

        Raises:
            ShuttingDown: where it was given up; the demands are still in the batch.
            DemandOpsError: where the state repo cannot be used; likewise.
        """
        self._must_fetch, self._tip_is_fresh = False, self._repository.always_current
        pace = Backoff(self._batch_limit)
        while batch:
            try:
                wait = self._attempt(batch, pace)
            except RemoteAway as error:
                _mark_maybe_published(batch, self.snapshot)
                self.fetcher.record_unreachable(error)
                self._tip_is_fresh = self._repository.always_current
                wait = pace.unreachable()
            if wait is None:
                continue
            # waited before the fetch: what is judged then is pushed while it is fresh
            self._wait_to_retry(batch, wait)
            if self._stopped_retrying.is_set():
                raise ShuttingDown(
                    "the remote is away; the demand stays in the outbox for the next start"
                )
            self._take(batch)

    def _attempt(self, batch: list[Ticket], pace: Backoff) -> float | None:
        """Judge and publish a part of a batch; return how long to wait where that was in vain.

        Raises:
            RemoteAway: where the remote cannot be reached.
        """
        # of a remote that is away nothing is judged: what is committed stays in
        if self._must_fetch or self.fetcher.remote.is_unreachable:
            self._repository.refresh()
            self._must_fetch, self._tip_is_fresh = False, True
        self._queue.answer_withdrawn(batch)
        part = batch[: pace.max_demands]
        self._approvals.remove_released(part, self.snapshot.state)
        line = self._new_commit_line()
        began = time.monotonic()
        arrived = self._evaluator.published_before(line.start, part)
        results: list[Result] = []
        for ticket in part:
            results.append((ticket, self._evaluator.evaluate(line, ticket, arrived, results)))
        judged = time.monotonic()
        if line.head.commit == line.start.commit and not self._tip_is_fresh:
            # only a push would have shown that the remote has moved
            tip = self._repository.refresh()
            self._tip_is_fresh = True
            if tip != line.start.commit:
                return None
        if self._publish_line(line, results):
            self._answer(results)
            del batch[: len(part)]
            pace.published()
            return None
        log.info("the state repo has moved; judging %d demands again", len(part))
        _mark_maybe_published(part, line.start)
        self._must_fetch = True
        return pace.overtaken(len(part), judged - began, time.monotonic() - judged)

    def _answer(self, results: list[Result]) -> None:
        """Answer what is settled; what needs approval waits on."""
        told = [(ticket, result) for ticket, result in results if not isinstance(result, Deferred)]
        self._queue.answer(told)
        for ticket, result in results:
            if isinstance(result, Deferred):
                self._approvals.add(ticket, result.decision)

    def check_proposals(self) -> None:
        """Look after the demands that await approval, with main as it is now."""
        if not self._approvals.is_due(str(self.snapshot.commit)):
            return
        try:
            heads = self._approvals.fetch_heads()
            if heads.main != str(self.snapshot.commit):
                self._repository.refresh()
                self.fetcher.carry_out_changes()
            # a branch that is gone may have been merged: only a newer main tells
            if self._repository.includes(str(self.snapshot.commit), heads.main):
                self._approvals.check(self.snapshot, heads)
        except (RemoteAway, PushDenied) as error:
            log.warning("%s; the demands that await approval wait on", error)

    def _wait_to_retry(self, batch: list[Ticket], seconds: float) -> None:
        """Let a while pass; demands that come in meanwhile are kept, and told why they wait."""
        end = time.monotonic() + seconds
        told = list(batch)
        while not self._stopped_retrying.is_set():
            if self.fetcher.remote.is_unreachable:
                for ticket in told:
                    ticket.notify("away", f"waiting: {self.fetcher.remote.status.unreachable}")
            self._queue.answer_withdrawn(batch)
            left = end - time.monotonic()
            if left <= 0:
                return
            told = self._queue.journal_arrivals(left)

    def seconds_until_due(self) -> float:
        """Return the seconds until leases, overrides, proposals or the state repo are due."""
        state = self.snapshot.state
        ends = self._lease_expiry.seconds_until_due(
            state.ledger, self._approvals.seconds_until_due(LONGEST_WAIT_S)
        )
        ends = self._override_expiry.seconds_until_due(state.config, _now(), ends)
        look = self.fetcher.seconds_until_due()
        return ends if look is None else min(ends, look)

    def retry_changes(self) -> None:
        """Try again what people changed and could not be carried out: a release may allow it."""
        if self.snapshot.problems:
            self.fetcher.carry_out_changes()

    def fetch_if_due(self) -> None:
        """Take in what others published, while no demand comes, and end overrides."""
        due = self._override_expiry.is_due(self.snapshot.state.config, _now())
        if not self.fetcher.fetch_if_due(self.snapshot, due):
            self._override_expiry.postpone(_now())

    def tidy(self) -> None:
        """Every few hundred commits: a demand leaves some twenty loose objects behind."""
        if self._commits_since_tidy >= _TIDY_EVERY:
            self._commits_since_tidy = 0
            self._repository.tidy()

    def _publish_line(self, line: commit_line.CommitLine, results: list[Result]) -> bool:
        """Publish a line; what the remote denies becomes the answer of all that is in it."""
        try:
            published = line.publish()
        except PushDenied as error:
            results[:] = [(t, error if isinstance(r, Receipt) else r) for t, r in results]
            self.fetcher.remote.record_push_denied(str(error))
            return True
        if not published:
            return False
        self.fetcher.record_reached(pushed=line.head.commit != line.start.commit)
        self._set_snapshot(line)
        self._commits_since_tidy += len(results)
        return True

    def _set_snapshot(self, line: commit_line.CommitLine) -> None:
        before, self.snapshot = self.snapshot, line.head
        if line.head.commit != before.commit:  # a merge may ask for no commit of our own
            self._on_published(line.head.state.config)

    def _new_commit_line(self) -> commit_line.CommitLine:
        """Start a line on the newest tip that is known, people's changes taken in."""
        tip = self._repository.tip()
        before = self.snapshot
        if tip == before.commit and not before.problems:
            line = commit_line.CommitLine(self._repository, before)
            self._override_expiry.end_due(line, _now())
            return line
        advance = self._ahead.advance(self._repository.objects, before, tip)
        line = commit_line.CommitLine(self._repository, advance.snapshot)
        line.follow(advance, before, _now())
        self.fetcher.log_problems(line.head.problems)
        self._override_expiry.end_due(line, _now())
        return line


def _mark_maybe_published(batch: list[Ticket], start: Snapshot) -> None:
    for ticket in batch:
        ticket.mark_maybe_published(str(start.commit))


def _now() -> datetime:
    return datetime.now(timezone.utc)
