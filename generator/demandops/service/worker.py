"""The worker: evaluates, commits and publishes batches of demands, again if the remote has moved.

Belongs to one thread, the only one that writes to the state repo.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

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
from demandops.staterepo.write import commit_batch

log = logging.getLogger("demandops")

_TIDY_EVERY = 300


class Worker:
    """Turns batches of demands into published commits.

    ``snapshot`` is the newest published state; any thread may read it.
    """

    def __init__(
        self,
        repository: StateRepository,
        snapshot: Snapshot,
        queue: DemandQueue,
        on_published: Callable[[Config], None],
        with_targets: bool,
        approvals: Approvals,
        fetch_interval: float = 0.0,
    ) -> None:
        self.snapshot = snapshot
        self._approvals = approvals
        self._repository, self._runtime = repository, repository.runtime
        self._queue = queue
        self._on_published = on_published
        self._evaluator = Evaluator(repository, queue, approvals, with_targets)
        self._must_fetch = False
        self._tip_is_fresh = False
        self._commits_since_tidy = 0
        self._lease_expiry = LeaseExpiry(self._runtime)
        self._override_expiry = OverrideExpiry()
        self._ahead = ReadAhead()
        self._stopped_retrying = self._runtime.event()
        embedded = repository.always_current
        self.fetcher = Fetcher(
            repository, queue, fetch_interval, self._new_commit_batch, self._set_snapshot
        )
        self._batch_limit = LIMIT_EMBEDDED if embedded else LIMIT_REMOTE

    def stop_retrying(self) -> None:
        """Stop waiting for a remote that cannot be reached; from any thread."""
        self._stopped_retrying.set()
        self.fetcher.stop_retrying()
        self._repository.abort()
        self._queue.wake()

    def take(self, batch: list[Ticket]) -> None:
        """Move queued demands into ``batch``, then the releases of ended leases.

        No lease ends while demands are queued, because one of them may renew it.
        """
        self._take_queued(batch)
        if not self._queue.has_waiting:
            batch += self._lease_expiry.tickets(self.snapshot.state.ledger)

    def _take_queued(self, batch: list[Ticket]) -> None:
        self._queue.take(batch, self._batch_limit)
        self._approvals.resume(batch, self.snapshot.state)

    def publish(self, batch: list[Ticket]) -> None:
        """Publish a batch, with the demands that arrive during retries, and empty it.

        Raises:
            ShuttingDown: after :meth:`stop_retrying`; the demands are still in the batch.
            DemandOpsError: if the state repo cannot be used; likewise.
        """
        self._must_fetch, self._tip_is_fresh = False, self._repository.always_current
        backoff = Backoff(self._batch_limit, self._runtime)
        while batch:
            try:
                wait = self._attempt(batch, backoff)
            except RemoteAway as error:
                _mark_maybe_published(batch, self.snapshot)
                self.fetcher.record_unreachable(error)
                self._tip_is_fresh = self._repository.always_current
                wait = backoff.unreachable()
            if wait is None:
                continue
            # wait before the fetch, not after it: the push must follow the fetch closely
            self._wait_to_retry(batch, wait)
            if self._stopped_retrying.is_set():
                raise ShuttingDown(
                    "the remote cannot be reached; the demand stays in the journal and is resumed "
                    "at the next start"
                )
            self._take_queued(batch)

    def _attempt(self, batch: list[Ticket], backoff: Backoff) -> float | None:
        """Evaluate and publish a part of a batch.

        Returns:
            The seconds to wait before the next attempt, or None to continue at once.

        Raises:
            RemoteAway: if the remote cannot be reached.
        """
        # fetch first: a demand that was committed can no longer be withdrawn
        if self._must_fetch or self.fetcher.remote.is_unreachable:
            self._repository.refresh()
            self._must_fetch, self._tip_is_fresh = False, True
        self._queue.answer_withdrawn(batch)
        part = batch[: backoff.max_demands]
        self._approvals.remove_released(part, self.snapshot.state)
        commits = self._new_commit_batch()
        began = self._runtime.monotonic()
        published = self._evaluator.published_before(commits.start, part)
        results: list[Result] = []
        for ticket in part:
            result = self._evaluator.evaluate(commits, ticket, published, results)
            results.append((ticket, result))
        evaluated = self._runtime.monotonic()
        if commits.head.commit == commits.start.commit and not self._tip_is_fresh:
            # nothing to push, so only a fetch shows whether the remote has moved
            tip = self._repository.refresh()
            self._tip_is_fresh = True
            if tip != commits.start.commit:
                return None
        if self._publish_commits(commits, results):
            self._answer(results)
            del batch[: len(part)]
            backoff.published()
            return None
        log.info("the state repo has moved; evaluating %d demands again", len(part))
        _mark_maybe_published(part, commits.start)
        self._must_fetch = True
        return backoff.overtaken(
            len(part), evaluated - began, self._runtime.monotonic() - evaluated
        )

    def _answer(self, results: list[Result]) -> None:
        """Answer the demands that have a final result; propose those that need approval."""
        final = [(ticket, result) for ticket, result in results if not isinstance(result, Deferred)]
        self._queue.answer(final)
        for ticket, result in results:
            if isinstance(result, Deferred):
                self._approvals.add(ticket, result.decision)

    def check_proposals(self) -> None:
        """Check the demands that await approval against the newest main, if it is time to."""
        if not self._approvals.is_due(str(self.snapshot.commit)):
            return
        try:
            heads = self._approvals.fetch_heads()
            if heads.main != str(self.snapshot.commit):
                self._repository.refresh()
                self.fetcher.carry_out_changes()
            # a deleted branch may have been merged: only a main at least as new shows that
            if self._repository.includes(str(self.snapshot.commit), heads.main):
                self._approvals.check(self.snapshot, heads)
        except (RemoteAway, PushDenied) as error:
            log.warning("%s; the demands that await approval keep waiting", error)

    def _wait_to_retry(self, batch: list[Ticket], seconds: float) -> None:
        """Wait; meanwhile journal new demands and report to them why they wait."""
        end = self._runtime.monotonic() + seconds
        to_notify = list(batch)
        while not self._stopped_retrying.is_set():
            if self.fetcher.remote.is_unreachable:
                for ticket in to_notify:
                    ticket.notify("away", f"waiting: {self.fetcher.remote.status.unreachable}")
            self._queue.answer_withdrawn(batch)
            left = end - self._runtime.monotonic()
            if left <= 0:
                return
            to_notify = self._queue.journal_arrivals(left)

    def seconds_until_due(self) -> float:
        """Return the seconds until a lease, override, proposal or fetch is due."""
        state = self.snapshot.state
        seconds = self._approvals.seconds_until_due(LONGEST_WAIT_S)
        seconds = self._lease_expiry.seconds_until_due(state.ledger, seconds)
        seconds = self._override_expiry.seconds_until_due(state, self._runtime.now(), seconds)
        fetch = self.fetcher.seconds_until_due()
        return seconds if fetch is None else min(seconds, fetch)

    def retry_changes(self) -> None:
        """Carry out quarantined changes again, because a release may have made them possible."""
        if self.snapshot.problems:
            self.fetcher.carry_out_changes()

    def fetch_if_due(self) -> None:
        """Carry out what others pushed and end overrides, while no demand comes."""
        due = self._override_expiry.is_due(self.snapshot.state, self._runtime.now())
        if not self.fetcher.fetch_if_due(self.snapshot, due):
            self._override_expiry.postpone(self._runtime.now())

    def tidy(self) -> None:
        """Pack the repository every few hundred commits; each adds about twenty loose objects."""
        if self._commits_since_tidy >= _TIDY_EVERY:
            self._commits_since_tidy = 0
            self._repository.tidy()

    def _publish_commits(self, commits: commit_batch.CommitBatch, results: list[Result]) -> bool:
        """Publish a commit batch; return False if another writer was first.

        If the remote rejects the push for another reason, that is the answer of all its demands.
        """
        try:
            published = commits.publish()
        except PushDenied as error:
            results[:] = [(t, error if isinstance(r, Receipt) else r) for t, r in results]
            self.fetcher.remote.record_push_denied(str(error))
            return True
        if not published:
            return False
        self.fetcher.record_reached(pushed=commits.head.commit != commits.start.commit)
        self._set_snapshot(commits)
        self._commits_since_tidy += len(results)
        return True

    def _set_snapshot(self, commits: commit_batch.CommitBatch) -> None:
        before, self.snapshot = self.snapshot, commits.head
        if commits.head.commit != before.commit:  # a merge may need no commit of the generator
            self._on_published(commits.head.state.config)

    def _new_commit_batch(self) -> commit_batch.CommitBatch:
        """Return a commit batch on the newest known tip, which carries out people's changes."""
        tip = self._repository.tip()
        before = self.snapshot
        if tip == before.commit and not before.problems:
            commits = commit_batch.CommitBatch(self._repository, before)
            self._override_expiry.end_due(commits, self._runtime.now())
            return commits
        advance = self._ahead.advance(self._repository.objects, before, tip)
        commits = commit_batch.CommitBatch(self._repository, advance.snapshot)
        commits.follow(advance, before, self._runtime.now())
        self.fetcher.log_problems(commits.head.problems)
        self._override_expiry.end_due(commits, self._runtime.now())
        return commits


def _mark_maybe_published(batch: list[Ticket], start: Snapshot) -> None:
    for ticket in batch:
        ticket.mark_maybe_published(str(start.commit))
