"""The worker: follows the state repo, and publishes the demands as commits.

The worker runs in one thread, the only one that writes to the state repo. Demands go first, so a
fetch stops when a demand arrives. The push of the demand finds new commits just as the fetch would.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from demandops.config.config import Config
from demandops.decision import Decision
from demandops.errors import (
    DemandOpsError,
    ShuttingDown,
    StateRepoError,
    Unsound,
    Withdrawn,
    internal,
)
from demandops.evaluator.process import DEMAND_S, processor_time
from demandops.service.approvals.approvals import Approvals, Result
from demandops.service.demand_lifecycle import Demands
from demandops.service.evaluation import Evaluator
from demandops.service.fault_log import FaultLog
from demandops.service.remote_status import RemoteMonitor
from demandops.service.ticket import Ticket
from demandops.service.timing.backoff import (
    LIMIT_LOCAL,
    LIMIT_REMOTE,
    LONGEST_EVALUATION_S,
    Backoff,
)
from demandops.service.timing.budget import may_take_long
from demandops.service.timing.expiry import LONGEST_WAIT_S, LeaseExpiry
from demandops.service.timing.heartbeat import Heartbeat
from demandops.service.timing.own_work import OwnWork
from demandops.service.timing.polling import PollTimer
from demandops.service.timing.rest import Rest
from demandops.staterepo.git.repository import (
    FetchInterrupted,
    PushDenied,
    StateRepository,
    Unavailable,
    access_error,
)
from demandops.staterepo.load.snapshot import ReadAhead, Snapshot
from demandops.staterepo.write.commit_batch import CommitBatch

log = logging.getLogger("demandops")

_TIDY_EVERY = 50
"""How many new Git packs to collect before git joins them; each publication or fetch adds one."""
_TRIES = 5
_LONGEST_PAUSE_S = 0.05
_NAME = "writer"


class Worker:
    """Follows the state repo and turns batches of demands into published commits.

    Any thread may read ``remote`` and ``snapshot`` (the newest published state). The worker calls
    the ``listeners`` with the configuration in effect whenever the published state changes.
    """

    def __init__(
        self,
        repository: StateRepository,
        snapshot: Snapshot,
        demands: Demands,
        approvals: Approvals,
        with_targets: bool,
        fetch_interval: float,
        heartbeat: Heartbeat,
    ) -> None:
        self.snapshot = snapshot
        self.listeners: list[Callable[[Config], None]] = []
        self.remote = RemoteMonitor(repository.address, repository.runtime)
        self._repository, self._demands, self._approvals = repository, demands, approvals
        self._runtime = repository.runtime
        self._heartbeat = repository.while_waiting = heartbeat
        self._evaluator = Evaluator(repository, demands, approvals, with_targets)
        self._timer = PollTimer(fetch_interval, repository.runtime, local=repository.always_current)
        self._lease_expiry = LeaseExpiry(repository.runtime)
        self._own_work = OwnWork(repository.runtime)
        self._ahead = ReadAhead()
        self._batch_limit = LIMIT_LOCAL if repository.always_current else LIMIT_REMOTE
        self._must_fetch = self._tip_is_fresh = False
        self._packs_since_tidy = 0
        self._log = FaultLog(repository)
        self._ends_soon = self._runtime.event()
        self._rest = Rest(repository.runtime)
        self._log.warn_if_unsigned(snapshot)

    # ---- from any thread ----

    def fetch_now(self) -> None:
        """Have the worker fetch as soon as no demand is queued, even if no fetch is due."""
        self._timer.request()
        self._demands.wake()

    def end_soon(self) -> None:
        """End a running transfer, and begin no further attempt to publish.

        Demands that are not published then stay in the journal.
        """
        self._ends_soon.set()
        self._repository.abort()
        self._demands.wake()

    # ---- the loop ----

    def run(self) -> None:
        """Publish demands, until no further demand is accepted and no demand is queued."""
        # people may have decided about proposals before the start, so answer these demands first
        with processor_time(each=DEMAND_S, meanwhile=self._heartbeat):
            if self._demands.proposed:
                self._work()
            while self._demands.wait(self._seconds_until_due()):
                self._heartbeat()
                self._work()
        self._approvals.suspend()

    def _work(self) -> None:
        """Publish the queued demands; if no demand is queued, follow the state repo.

        Check the proposals afterwards.
        """
        batch: list[Ticket] = []
        try:
            self._demands.take(batch, self._batch_limit)
            if batch or self._ended_leases(self.snapshot):
                self._publish(batch)
                if self.snapshot.problems:  # after a release, an invalid change may be valid
                    self._try_to_carry_out_changes()
            elif not self._rest:
                self._follow()
            if self._packs_since_tidy >= _TIDY_EVERY:
                self._packs_since_tidy = 0
                self._repository.tidy()
            if not self._rest:
                self._check_proposals()
        except Exception as error:
            self._fail(
                batch, access_error(error, self._repository.address, self._repository.objects)
            )
        else:
            if not self._rest:
                self._rest.succeeded()
                self._runtime.recovered(_NAME)

    def _fail(self, batch: list[Ticket], error: Exception) -> None:
        """Answer a batch with an error; if the batch is empty, stop fetching for a while.

        Raises:
            Unsound: if ``error`` is an ``Unsound``. The process must end then; the journal is kept.
        """
        if isinstance(error, Unsound):
            self._demands.end(error)
            raise error
        if isinstance(error, ShuttingDown):
            self._demands.fail(batch, error, keep=True)
            return
        # an expected error is in the answers to the demands, so only other errors are recorded
        if not batch or not isinstance(error, DemandOpsError):
            self._runtime.failed(_NAME, error)
        if not batch:
            self._begin_rest()
        if not isinstance(error, DemandOpsError):
            error = internal(error)
        self._demands.fail(batch, error)

    def _begin_rest(self) -> None:
        if self._rest.follows_success:
            self._renew_clone_if_damaged()
        self._rest.begin()
        self._timer.finished(reached=False)

    def _renew_clone_if_damaged(self) -> None:
        try:
            self._repository.renew_if_damaged()
        except StateRepoError as error:
            log.warning("%s", error)

    def _seconds_until_due(self) -> float:
        """Return the seconds until a lease, override, scale-down, proposal or fetch is due.

        During a rest, return the seconds until its end.
        """
        if self._rest:
            return self._rest.seconds_left()
        state, tip = self.snapshot.state, str(self.snapshot.commit)
        seconds = self._approvals.seconds_until_due(tip, LONGEST_WAIT_S)
        seconds = self._lease_expiry.seconds_until_due(state.ledger, seconds)
        seconds = self._own_work.seconds_until_due(state, seconds)
        fetch = self._timer.seconds_until_due()
        return seconds if fetch is None else min(seconds, fetch)

    # ---- publishing demands ----

    def _publish(self, batch: list[Ticket]) -> None:
        """Publish a batch, the demands that arrive during retries, and the ends of leases.

        The batch is empty afterwards. The demands that the worker had no time to evaluate are
        in the queue again.

        Raises:
            ShuttingDown: after :meth:`end_soon`; the demands are still in the batch.
            DemandOpsError: if the state repo cannot be used; the demands are still in the batch.
        """
        self._must_fetch, self._tip_is_fresh = False, self._repository.always_current
        backoff = Backoff(self._batch_limit, self._runtime)
        while batch or self._ended_leases(self.snapshot):
            self._heartbeat()
            self._require_not_ending()
            try:
                wait = self._attempt(batch, backoff)
            except Exception as error:
                reason = access_error(error, self._repository.address, self._repository.objects)
                if isinstance(reason, PushDenied):
                    self.remote.record_push_denied(str(reason))
                if not isinstance(reason, Unavailable):
                    raise reason from None
                for ticket in batch:
                    ticket.mark_maybe_published(str(self.snapshot.commit))
                self._record_unreachable(reason)
                self._tip_is_fresh = self._repository.always_current
                wait = backoff.unreachable()
            if wait is None:
                continue
            # wait before the fetch, not after it, because the push must follow the fetch closely
            self._wait_to_retry(batch, wait)
            self._require_not_ending()
            self._demands.take(batch, self._batch_limit)

    def _require_not_ending(self) -> None:
        if self._ends_soon.is_set():
            reason = self._demands.blocked or "the generator stops"
            raise ShuttingDown(
                f"{reason}; the demand stays in the journal and is resumed at the next start"
            )

    def _attempt(self, batch: list[Ticket], backoff: Backoff) -> float | None:
        """Evaluate and publish a part of a batch.

        Returns:
            The seconds to wait before the next attempt, or None to continue at once.
        """
        # fetch before a demand is committed, because after that it can no longer be withdrawn
        if self._must_fetch or self.remote.status.unreachable:
            self._repository.refresh()
            self._must_fetch, self._tip_is_fresh = False, True
        self._demands.answer_withdrawn(batch)
        tip = self._repository.tip()
        results = self._evaluator.published_before(str(tip), batch)
        published = {ticket for ticket, _ in results}
        independent = len(results)
        left = [ticket for ticket in batch if ticket not in published]
        part, left = left[: backoff.max_demands], left[backoff.max_demands :]
        self._approvals.remove_released(part, self.snapshot.state)
        commits = self._new_commit_batch()
        if commits.start.commit != tip:
            return None
        began = self._runtime.monotonic()
        for number, ticket in enumerate(part):
            self._require_not_ending()
            is_late = self._runtime.monotonic() - began > LONGEST_EVALUATION_S
            if number and (is_late or may_take_long(ticket.goal)):
                part, left = part[:number], part[number:] + left
                break
            self._approvals.withdraw_released(results, ticket, commits.head.state)
            results.append(self._evaluated(commits, ticket))
            if commits.is_empty:
                independent = len(results)
        if not left:
            for ticket in self._ended_leases(commits.head)[: backoff.max_demands - len(part)]:
                results.append(self._evaluated(commits, ticket))
                if self._runtime.monotonic() - began > LONGEST_EVALUATION_S:
                    break
        evaluated = self._runtime.monotonic()
        if commits.is_empty and not self._tip_is_fresh:
            # nothing to push, so only a fetch shows whether the remote has moved
            self._tip_is_fresh = True
            if self._repository.refresh() != commits.start.commit:
                return None
        if self._publish_commits(commits, results, independent):
            batch[:] = left
            self._demands.put_back(batch, [ticket for ticket, _ in results])
            backoff.published()
            return None
        log.info("another writer was first; evaluating %d demands again", len(results))
        for ticket in part:
            ticket.mark_maybe_published(str(commits.start.commit))
        self._must_fetch = True
        return backoff.overtaken(
            len(results), evaluated - began, self._runtime.monotonic() - evaluated
        )

    def _evaluated(self, commits: CommitBatch, ticket: Ticket) -> Result:
        """Evaluate a demand, and book waiting demands if the demand frees room.

        Returns:
            The demand with its result.
        """
        self._heartbeat()
        before = commits.head.state
        result = ticket, self._evaluator.evaluate(commits, ticket)
        self._own_work.follow(commits, before)
        return result

    def _ended_leases(self, snapshot: Snapshot) -> list[Ticket]:
        """Return a ticket for each demand whose lease has ended, to release its claims.

        Return no ticket during a rest, or while a demand is queued, which may renew a lease.
        """
        if self._rest or self._demands.has_queued:
            return []
        return self._lease_expiry.tickets(snapshot.state.ledger)

    def _publish_commits(
        self, commits: CommitBatch, results: list[Result], independent: int
    ) -> bool:
        """Publish a commit batch and answer its demands, or return false and answer none.

        The result is false if another writer was first or locks main. If the remote denies the
        push, each demand in ``results`` gets :class:`PushDenied` as its answer, except the first
        ``independent`` demands and withdrawn demands.

        Args:
            commits: the commits of the demands.
            results: the demands and their results, in the order of evaluation.
            independent: how many demands were decided before the batch had a commit, so that their
                results do not depend on the push.
        """
        try:
            published = commits.publish()
        except PushDenied as error:
            results[independent:] = [
                (ticket, result if isinstance(result, Withdrawn) else error)
                for ticket, result in results[independent:]
            ]
            self.remote.record_push_denied(str(error))
        else:
            if not published:
                return False
            self._record_reached(pushed=not commits.is_empty)
            self._record_published(commits)
        final = [(ticket, result) for ticket, result in results if not isinstance(result, Decision)]
        self._demands.answer(final)
        for ticket, result in results:
            if isinstance(result, Decision):
                self._approvals.add(ticket, result)
        return True

    def _wait_to_retry(self, batch: list[Ticket], seconds: float) -> None:
        """Wait for ``seconds``; meanwhile answer withdrawn demands.

        If the remote cannot be reached, report the reason to the batch and to new demands.
        """
        end = self._runtime.monotonic() + seconds
        to_notify = list(batch)
        while not self._ends_soon.is_set():
            unreachable = self.remote.status.unreachable
            for ticket in to_notify if unreachable else ():
                ticket.notify("away", f"waiting: {unreachable}")
            self._demands.answer_withdrawn(batch)
            left = end - self._runtime.monotonic()
            if left <= 0:
                return
            to_notify = self._demands.new_demands(left)

    # ---- following the state repo ----

    def _follow(self) -> None:
        """Fetch if a fetch is due, carry out people's changes, and do the work of :class:`OwnWork`.

        In a repository on this disk, the worker reads the tip in every call, because that is cheap.
        """
        is_due = self._own_work.is_due(self.snapshot.state)
        try:
            if self._timer.start_if_due():
                self._repository.refresh(lambda: self._demands.must_not_wait)
            elif not (self._repository.always_current or is_due):
                return
            new = is_due or self._repository.tip() != self.snapshot.commit
            self._record_reached(pushed=new and self._carry_out_changes())
        except FetchInterrupted:
            self._timer.request()  # the fetch is still due
        except StateRepoError as error:
            self._record_unreachable(error)
            self._own_work.postpone()

    def _check_proposals(self) -> None:
        if not self._approvals.is_due(str(self.snapshot.commit)):
            return
        try:
            heads = self._approvals.fetch_heads()
            if heads.main != str(self.snapshot.commit):
                self._repository.refresh()
                self._try_to_carry_out_changes()
            # a deleted branch may have been merged, which only a main as new as ``heads`` shows
            if self._repository.includes(str(self.snapshot.commit), heads.main):
                self._approvals.check(self.snapshot, heads)
        except (Unavailable, PushDenied) as error:
            log.warning("%s; the demands that await approval keep waiting", error)

    def _try_to_carry_out_changes(self) -> None:
        try:
            self._carry_out_changes()
        except StateRepoError as error:
            self._record_unreachable(error)

    def _carry_out_changes(self) -> bool:
        """Publish the effects of people's changes; return whether this published a commit.

        The caller has fetched the changes. This method fetches only after another writer published
        first.
        """
        for _ in range(_TRIES):
            commits = self._new_commit_batch()
            if commits.publish():
                self._record_published(commits)
                return not commits.is_empty
            self._repository.refresh()
            self._ends_soon.wait(self._runtime.uniform(0, _LONGEST_PAUSE_S))
        return False  # other generators are faster, and they carry out the same changes

    def _new_commit_batch(self) -> CommitBatch:
        """Return a commit batch on the newest known tip.

        Its first commits render people's changes, and do the work of :class:`OwnWork` that is due.
        """
        tip = self._repository.tip()
        before = self.snapshot
        if tip == before.commit and not before.problems and before.is_rendered:
            commits = CommitBatch(self._repository, before)
        else:
            advance = self._ahead.advance(self._repository.objects, before, tip)
            commits = CommitBatch(self._repository, advance.snapshot)
            commits.follow(advance, before, self._runtime.now())
            self._log.log_changes(commits.head.problems)
        self._own_work.commit_due(commits)
        return commits

    def _record_published(self, commits: CommitBatch) -> None:
        if commits.followed:
            log.info("%s", commits.followed)
        self._set_snapshot(commits.head)

    def _set_snapshot(self, snapshot: Snapshot) -> None:
        before, self.snapshot = self.snapshot, snapshot
        # also true after a person's merge that needs no commit of the generator
        if snapshot.commit != before.commit:
            self._packs_since_tidy += 1
            self._log.warn_if_unsigned(snapshot)
            for listener in self.listeners:
                listener(snapshot.state.config)

    def _record_reached(self, *, pushed: bool) -> None:
        self._demands.blocked = ""
        self.remote.record_reached(pushed=pushed)
        self._timer.finished(reached=True)

    def _record_unreachable(self, error: StateRepoError) -> None:
        if self._ends_soon.is_set():  # there is no retry to report
            return
        self._demands.blocked = str(error)
        self.remote.record_unreachable(str(error))
        self._timer.finished(reached=False)
