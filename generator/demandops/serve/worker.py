"""The worker: follows the state repo, decides the demands, and publishes them as commits."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from math import inf

from demandops.base import errors
from demandops.base.errors import DemandOpsError, StateRepoError
from demandops.base.runtime import log
from demandops.base.settings import MAIN_BRANCH
from demandops.decide.decision import Decision, Outcome, decide
from demandops.model.config.config import Config
from demandops.model.demand.demand import Demand, Rollback
from demandops.repo.git import repository as repositories
from demandops.repo.git.repository import PushDenied, Unavailable, access_error
from demandops.repo.git.signing import ALLOWED_SIGNERS, SigningFailed, are_listed
from demandops.repo.history.commit_log import operations_since
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.ledger_files import restoration
from demandops.repo.load.snapshot import Snapshot
from demandops.repo.write.commit_batch import CommitBatch
from demandops.serve import agenda
from demandops.serve.agenda import Agenda, Backoff, RateLimit, What
from demandops.serve.approvals import Approvals, Result
from demandops.serve.demands import Demands
from demandops.serve.journal import Receipt, Ticket
from demandops.serve.node_discovery import NodeDiscovery, NodesOf
from demandops.templating.evaluator import DEMAND_S, processor_time

# The worker runs in one thread, the only one that writes to the state repo. Demands go first, so a
# fetch stops when a demand arrives. The push of the demand finds new commits just as the fetch
# would.

# How many new Git packs to collect before git joins them; each publication or fetch adds one.
_TIDY_EVERY = 50
# How often to carry out a change by a person while other generators, which do the same, are faster.
_TRIES = 5
# How often a demand's commit must be refused alone, while another commit is accepted in between,
# before it counts as refused: with a verdict of the server, and without one, as the connection may
# have failed.
_REFUSALS, _REFUSALS_WITHOUT_VERDICT = 2, 6
_MOST_LOGGED = 20  # faults of claims, of which one commit may bring thousands
_NAME = "writer"  # the thread's name, under which a health check reports its failure


class Worker:
    # Any thread may read ``remote`` and ``snapshot`` (the newest published state).

    def __init__(
        self,
        repository: repositories.StateRepository,
        snapshot: Snapshot,
        demands: Demands,
        approvals: Approvals,
        fetch_interval: float,
        heartbeat: Callable[[], object],
        refusal_patience_s: float,
    ) -> None:
        self.snapshot = snapshot
        self.listeners: list[Callable[[Config], None]] = []
        self.remote = demands.remote
        self._repository, self._demands, self._approvals = repository, demands, approvals
        self._runtime = repository.runtime
        self._heartbeat = repository.while_waiting = heartbeat
        self._rate_limit = RateLimit()
        self._agenda = Agenda(fetch_interval, self._runtime, local=repository.on_this_disk)
        self._batch_limit = agenda.LIMIT_LOCAL if repository.always_current else agenda.LIMIT_REMOTE
        self._backoff = Backoff(self._batch_limit, self._runtime)
        self._tip_is_fresh = False
        self._refusal_patience_s = refusal_patience_s
        # the demand whose commit was refused alone, how often, and whether another was accepted
        self._suspect: Demand | None = None
        self._refusals, self._is_writer_proven = 0, False
        # after a refusal, own work that is due is left out, as it may be what is refused
        self._leaves_due_work = False
        self._packs_since_tidy = 0
        self._logged: tuple[errors.Fault, ...] = ()
        # what a refused demand is told while the configuration of main is not in effect
        self._not_in_effect = ""
        self._warned_of_signers = False
        self._ends_soon = self._runtime.event()
        self._warn_if_unsigned()

    # ---- from any thread ----

    def fetch_now(self) -> None:
        self._agenda.wants_fetch.set()
        self._demands.wake()

    def take_over_nodes(self, nodes_of: NodesOf) -> None:
        """Keep the nodes of clusters as ``nodes_of`` gives them; ``nodes_changed`` says when."""
        self._agenda.nodes = [NodeDiscovery(nodes_of, self._runtime)]
        self._demands.wake()

    def nodes_changed(self) -> None:
        for nodes in self._agenda.nodes:
            nodes.has_news()
        self._demands.wake()

    def end_soon(self) -> None:
        """End a running transfer and begin no other; what is unpublished stays in the journal."""
        self._ends_soon.set()
        self._repository.abort()
        self._demands.wake()

    # ---- the loop ----

    def run(self) -> None:
        with processor_time(each=DEMAND_S, meanwhile=self._heartbeat):
            # people may have decided about proposals before the start: answer these demands first
            if self._demands.proposed:
                self._work()
            while self._demands.wait(min(self._due_in().values())):
                self._heartbeat()
                self._work()
        self._approvals.suspend()

    def _due_in(self, *, has_news: bool = False) -> dict[What, float]:
        main = str(self.snapshot.commit) if self._approvals.proposals else ""
        return self._agenda.due_in(self.snapshot.state, main, has_news=has_news)

    def _work(self) -> None:  # noqa: PLR0912
        batch: list[Ticket] = []
        try:
            # demands before fetches: the push of a demand finds new commits just as a fetch would
            self._demands.take(batch, self._batch_limit)
            if batch or self._ended_leases(self.snapshot):
                self._publish(batch)
            elif not self._agenda.waits_s("all"):
                self._follow()
            if self._agenda.must_judge and not self._due_in()["judge"]:
                began = self._runtime.monotonic()
                self._agenda.must_judge = False
                self._try_to_carry_out_changes(again=True)
                self._agenda.judged(began)
            if self._packs_since_tidy >= _TIDY_EVERY:
                self._packs_since_tidy = 0
                self._repository.tidy()
            if self._approvals.proposals and not self._agenda.waits_s("all"):
                self._check_proposals()
        except Exception as failure:
            error = access_error(failure, self._repository.address, self._repository.objects)
            if isinstance(error, errors.Unsound):
                self._demands.end(error)  # the process must end; the next one reads the journal
                raise error from failure
            if isinstance(error, errors.ShuttingDown):
                self._demands.fail(batch, error, keep=True)
                return
            # an expected error is in the answers to the demands, so only others are recorded
            if not batch or not isinstance(error, DemandOpsError):
                self._runtime.failed(_NAME, error)
            if not batch:
                # not at each failure in a row, because git then reads all objects
                if self._agenda.failed("all", first=agenda.FIRST_PAUSE_S) == agenda.FIRST_PAUSE_S:
                    try:
                        self._repository.renew_if_damaged()
                    except StateRepoError as damage:
                        log.warning("%s", damage)
                self._agenda.fetched(reached=False)
            if not isinstance(error, DemandOpsError):
                error = errors.internal(error)
            self._demands.fail(batch, error)
        else:
            if not self._agenda.waits_s("all"):
                self._runtime.recovered(_NAME)

    # ---- publishing demands ----

    def _publish(self, batch: list[Ticket]) -> None:
        # also the demands that arrive during retries, and the ends of leases; the batch is empty
        # afterwards, unless an error is raised
        must_fetch = bool(self.remote.unreachable)
        self._tip_is_fresh = self._repository.always_current
        self._suspect, self._leaves_due_work = None, False
        self._backoff.begin_anew()
        while batch or self._ended_leases(self.snapshot):
            self._heartbeat()
            self._require_not_ending()
            try:
                wait = self._attempt(batch, must_fetch)
            except Exception as failure:
                reason = access_error(failure, self._repository.address, self._repository.objects)
                if not isinstance(reason, Unavailable | PushDenied):
                    raise reason from None
                # the connection may have ended after the remote accepted the push
                for ticket in batch:
                    ticket.mark_maybe_published(str(self.snapshot.commit))
                patience_s = self._refusal_patience_s - self._record_failure(reason)
                wait = self._backoff.unreachable()
                if isinstance(reason, Unavailable):
                    wait = max(wait, reason.retry_after_s)
                elif patience_s > 0:
                    wait = min(wait, patience_s)
                else:
                    self._demands.fail(batch, reason)
                    batch.clear()
                    return
            # fetch before a demand is committed, because after that it can no longer be withdrawn
            if not (must_fetch := wait is not None):
                continue
            # Wait before the fetch, not after it, because the push must follow the fetch closely.
            # Meanwhile tell the demands what they wait for.
            end, to_notify = self._runtime.monotonic() + wait, list(batch)
            while not self._ends_soon.is_set():
                blocked = self.remote.blocked
                for ticket in to_notify if blocked else ():
                    ticket.notify("away", f"waiting: {blocked}")
                seconds = end - self._runtime.monotonic()
                if seconds <= 0:
                    break
                to_notify = self._demands.new_demands(seconds)
            self._require_not_ending()
            self._demands.take(batch, self._batch_limit)

    def _require_not_ending(self) -> None:
        if self._ends_soon.is_set():
            reason = self.remote.blocked or "the generator stops"
            raise errors.ShuttingDown(
                f"{reason}; the demand stays in the journal and is resumed at the next start"
            )

    def _attempt(self, batch: list[Ticket], must_fetch: bool) -> float | None:  # noqa: PLR0912
        # the seconds to wait before the next attempt, or None to continue at once
        if must_fetch:
            self._repository.refresh()
            self._tip_is_fresh = True
        tip = self._repository.tip()
        results = self._published_before(str(tip), batch)
        booked = {ticket for ticket, _ in results}
        independent = len(results)
        left = [ticket for ticket in batch if ticket not in booked]
        part, left = left[: self._backoff.max_demands], left[self._backoff.max_demands :]
        if self._approvals.proposals:
            self._approvals.remove_released(part, self.snapshot.state)
        commits = self._new_commit_batch()
        # a person may have written to a repository on this disk since the tip was read, and the
        # search for published demands and the deletion of released branches hold only for that tip
        if commits.start.commit != tip:
            return None
        began, has_own_work = self._runtime.monotonic(), not commits.is_empty
        for number, ticket in enumerate(part):
            self._require_not_ending()
            is_late = self._runtime.monotonic() - began > agenda.LONGEST_EVALUATION_S
            is_long = len(json.dumps(ticket.demand.goal)) > agenda.USUAL_LENGTH
            # it may release a demand of this batch, which must be proposed first
            proposes = any(isinstance(result, Decision) for _, result in results)
            if number and (is_late or is_long or (ticket.demand.is_release and proposes)):
                part, left = part[:number], part[number:] + left
                break
            results.append(self._evaluate(commits, ticket))
            if commits.is_empty:
                independent = len(results)
        # leases end last, because a demand that is still left may renew one
        if not left:
            for ticket in self._ended_leases(commits.head)[: self._backoff.max_demands - len(part)]:
                results.append(self._evaluate(commits, ticket))
                if self._runtime.monotonic() - began > agenda.LONGEST_EVALUATION_S:
                    break
        evaluated = self._runtime.monotonic()
        if commits.is_empty and not self._tip_is_fresh:
            # nothing to push, so only a fetch shows whether the remote has moved
            self._tip_is_fresh = True
            if self._repository.refresh() != commits.start.commit:
                return None
        try:
            published = self._publish_commits(commits, results)
            if commits.is_empty:  # so the tip is fresh
                self._record_reached()
        except PushDenied as refusal:
            # what was decided before the batch had a commit does not depend on the push
            self._answer(results[:independent])
            refused = [ticket for ticket, _ in results[independent:]]
            batch[:] = [ticket for ticket in part if ticket in refused] + left
            if has_own_work and len(refused) == 1:  # which of the two is refused?
                refused = []
            return self._isolate(refused, batch, refusal)
        if published:
            batch[:] = left
            self._demands.put_back(batch, [ticket for ticket, _ in results])
            self._backoff.begin_anew()
            return None
        log.info("another writer was first; evaluating %d demands again", len(results))
        for ticket in part:
            ticket.mark_maybe_published(str(commits.start.commit))
        return self._backoff.overtaken(
            len(results), evaluated - began, self._runtime.monotonic() - evaluated
        )

    def _evaluate(self, commits: CommitBatch, ticket: Ticket) -> Result:
        self._heartbeat()
        before = commits.head.state
        result = self._result_of(commits, ticket)
        # those that wait get the room that this demand frees before the next demand can take it
        self._agenda.book_those_let_in(commits, before)
        return ticket, result

    def _result_of(  # noqa: PLR0912
        self, commits: CommitBatch, ticket: Ticket
    ) -> Receipt | DemandOpsError | Decision:
        # A demand that needs approval gets no commit; its result is the decision. A receipt is true
        # only once the batch is published. Errors that concern all demands are raised; others leave
        # the rest of the batch alone.
        if ticket.withdrawn:
            return errors.Withdrawn(ticket.withdrawn)
        if ticket.unread is not None:
            return ticket.unread
        try:
            demand: Demand = ticket.demand
            if isinstance(demand, Rollback):
                if not self._repository.includes(str(commits.start.commit), demand.to):
                    message = f"commit {demand.to} is not in the history of the state repo; roll "
                    raise errors.Refused.at("", f"{message}back to one that is")
                demand = restoration(self._repository.objects, demand)
            state = commits.head.state
            # of all services, once for each configuration; that is not this demand's work
            _ = state.usage, state.names
            # what was booked must be released or restored, however long all of it takes
            with processor_time(each=DEMAND_S, together=DEMAND_S if demand.adds_claims else inf):
                decision = decide(
                    state,
                    demand,
                    ticket.received,
                    commits.read,
                    lambda stage: ticket.notify(stage, stage),
                    lambda request, config: self._rate_limit.faults(
                        request, config, ticket.operation, ticket.received
                    ),
                    agenda.within(state.config.repo_settings.limits, self._runtime),
                )
            if self._approvals.proposals:
                self._approvals.refuse_strangers(decision)
            if decision.approval:
                return decision
            # from here on the demand can no longer be taken back
            if not self._demands.commit(ticket):
                return errors.Withdrawn(ticket.withdrawn)
            if decision.request.operation == "put":
                self._approvals.withdraw_replaced(decision.request)
            if decision.outcome == "waiting":
                ticket.notify("waiting", f"waiting for room: {'; '.join(decision.warnings)}")
            if decision.files:
                now = self._runtime.now()
                commit = commits.commit(decision, ticket.operation, ticket.received, now)
                ticket.notify("committed", f"committed {commit}")
            else:
                waits = decision.outcome == "waiting"  # the demand waited already
                commits.record_in_next_commit(ticket.operation, "waiting" if waits else "unchanged")
                commit = str(commits.head.commit)
            return Receipt.of(
                ticket.operation, decision, commit, state, self._approvals.with_targets
            )
        except errors.InvalidInput as error:
            if ticket.has_released:  # the demand released a proposal, which had no claims yet
                commits.record_in_next_commit(ticket.operation, "released")
                commit = str(commits.head.commit)
                return Receipt(ticket.operation, ticket.demand.id, "released", commit)
            commits.record_in_next_commit(ticket.operation, "refused")
            if self._not_in_effect:  # perhaps the demand is allowed by a file that is not in effect
                cause, *more = error.faults
                cause = replace(cause, message=f"{cause.message}; {self._not_in_effect}")
                return type(error)([cause, *more])
            return error
        except SigningFailed as error:
            return error
        except Exception as error:  # a bug that one demand triggers must not stop the others
            reason = repositories.disk_error(error, self._repository.address)
            if reason is not None:  # the state repo fails, so no demand can be evaluated
                raise reason from None
            # a file that only this demand reads may be damaged
            if getattr(error, "errno", None) is None:
                told = access_error(error, self._repository.address, self._repository.objects)
                if isinstance(told, StateRepoError):
                    if self._repository.renew_if_damaged():
                        raise Unavailable(f"{told}; the clone is made anew") from None
                    return told
            log.exception("internal error while evaluating demand %s", ticket.operation)
            return errors.internal(error)

    def _published_before(self, tip: str, batch: list[Ticket]) -> list[Result]:
        # Oldest first, the results of those demands that main records already. They have no answer
        # because the process or the connection ended after the push, or because an fsync failed.
        sought = {ticket.operation: ticket for ticket in batch if ticket.maybe_published}
        bases = dict.fromkeys(ticket.base for ticket in sought.values())
        objects = self._repository.objects
        histories = [(base, operations_since(objects, tip, base)) for base in bases]
        # all bases are ancestors of the tip, so the most outcomes are those since the oldest base
        since, recorded = max(histories, key=lambda history: len(history[1]), default=("", {}))
        if published := [operation for operation in reversed(recorded) if operation in sought]:
            # after a failed fsync only files that are written anew are sure to be on the disk
            self._repository.write_anew(since)
        for operation in sought.keys() - published:
            sought[operation].base = tip  # the next search begins here
        results = list[Result]()
        for ticket in (sought[operation] for operation in published):
            record = recorded[ticket.operation]
            if record.outcome == "refused":
                message = "the demand was refused, but the reason was lost; send the demand again"
                results.append((ticket, errors.Refused.at("", message, code="refused")))
                continue
            outcome: Outcome = "booked"
            if record.outcome != "changed":
                outcome = record.outcome
            elif ticket.demand.operation == "rollback":
                outcome = "restored"
            elif ticket.demand.is_release or ticket.demand.operation == "decommission":
                outcome = "released"
            receipt = Receipt(ticket.operation, ticket.demand.id, outcome, record.commit)
            results.append((ticket, receipt))
        return results

    def _ended_leases(self, snapshot: Snapshot) -> list[Ticket]:
        # a queued demand may renew a lease
        if self._demands.has_queued or self._agenda.waits_s("all"):
            return []
        return self._agenda.lease_tickets(snapshot.state.ledger)

    def _publish_commits(self, commits: CommitBatch, results: Iterable[Result] = ()) -> bool:
        # false, without answers, if another writer was first or locks main
        if not commits.publish():
            return False
        if not commits.is_empty:
            self._record_reached(pushed=True)
            self._is_writer_proven = True
        self._record_published(commits)
        self._answer(list(results))
        return True

    def _answer(self, results: list[Result]) -> None:
        final = [(ticket, result) for ticket, result in results if not isinstance(result, Decision)]
        self._demands.answer(final)
        for ticket, result in results:
            if isinstance(result, Decision):
                self._approvals.add(ticket, result)

    def _isolate(
        self, refused: list[Ticket], batch: list[Ticket], refusal: PushDenied
    ) -> float | None:
        """Find out by further pushes whether the commits or the writer are refused.

        After a refusal, half of the demands are tried, down to one. If its commit is refused while
        another commit is accepted, the server refuses this demand, which is answered so. If the
        other commit is refused too, the server refuses the writer, and that refusal is raised.
        """
        for ticket in batch:
            ticket.mark_maybe_published(str(self.snapshot.commit))
        self._backoff.max_demands = max(1, len(refused) // 2)
        self._leaves_due_work = True
        if len(refused) > 1:
            return None
        for ticket in refused:
            if ticket not in batch:  # the end of a lease, which is tried again in a minute
                self._demands.fail([ticket], refusal)
                continue
            if ticket.demand != self._suspect:
                self._suspect, self._refusals, self._is_writer_proven = ticket.demand, 0, False
            self._refusals += 1
            enough = _REFUSALS if refusal.is_verdict else _REFUSALS_WITHOUT_VERDICT
            if self._is_writer_proven and self._refusals < enough:
                return self._backoff.unreachable()
            if self._is_writer_proven:
                log.warning("demand %s: %s", ticket.operation, refusal)
                self._demands.fail([ticket], refusal)
                batch.remove(ticket)
                self._suspect = None
                self._backoff.begin_anew()
                return None
        # the smallest commit: of people's changes, or else one without files
        commits = self._new_commit_batch()
        if commits.is_empty:
            now = self._runtime.now()
            title, why = "Check that the server takes commits", "Why: it refused another commit."
            commits.commit_without_files([[title], [why]], [("Operation", "follow")], now)
        self._publish_commits(commits)
        return None

    # ---- following the state repo ----

    def _follow(self) -> None:
        due_in = self._due_in()
        is_due = due_in["own work"] == 0
        try:
            if due_in["fetch"] == 0:
                self._agenda.wants_fetch.clear()  # before: a later push needs another fetch
                # a demand that arrives ends the fetch, because its push finds new commits too
                self._repository.refresh(
                    lambda: self._demands.has_queued or self._demands.is_closed
                )
            # in a repository on this disk, each turn reads the tip, because that is cheap
            elif not (self._repository.always_current or is_due):
                return
            new = is_due or self._repository.tip() != self.snapshot.commit
            self._record_reached()
            if new:
                self._carry_out_changes()
        except repositories.FetchInterrupted:
            self._agenda.wants_fetch.set()  # it is still due
        except StateRepoError as error:
            self._record_failure(error)
            self._agenda.failed("own work")

    def _check_proposals(self) -> None:
        if self._due_in(has_news=self._approvals.has_news)["check"] > 0:
            return
        try:
            self._agenda.check_begins()
            heads = self._approvals.branches.heads()
            if heads.main != str(self.snapshot.commit):
                self._repository.refresh()
                self._try_to_carry_out_changes()
            # a deleted branch may have been merged, which only a main as new as ``heads`` shows
            if self._repository.includes(str(self.snapshot.commit), heads.main):
                self._approvals.check(self.snapshot, heads, self._publish_commits)
                self._agenda.checked(str(self.snapshot.commit))
        except (Unavailable, PushDenied) as error:
            log.warning("%s; the demands that await approval keep waiting", error)

    def _try_to_carry_out_changes(self, *, again: bool = False) -> None:
        try:
            self._carry_out_changes(again=again)
        except StateRepoError as error:
            self._record_failure(error)

    def _carry_out_changes(self, *, again: bool = False) -> None:
        # publishes the effects of people's changes, which the caller has fetched
        self._leaves_due_work = False
        for _ in range(_TRIES):
            if self._publish_commits(self._new_commit_batch(again=again)):
                return
            self._repository.refresh()
            # at random, so that generators which all saw the change do not collide again
            self._ends_soon.wait(self._runtime.uniform(0, 0.05))
        # other generators are faster, and they carry out the same changes
        self._agenda.failed("own work")

    def _new_commit_batch(self, *, again: bool = False) -> CommitBatch:
        # its first commits render people's changes, and do the own work that is due
        tip = self._repository.tip()
        newest = self.snapshot
        if tip == newest.commit and newest.is_settled and not again:
            commits = CommitBatch(self._repository, newest)
        else:
            objects, now = self._repository.objects, self._runtime.now()
            snapshots.refuse_other_render_version(objects, tip)
            followed = snapshots.follow(objects, newest, tip, now, again=again)
            followed = snapshots.with_started_leases(objects, followed, now)
            commits = CommitBatch(self._repository, followed.snapshot)
            commits.follow(followed, now)
            self._tell_of_faults(followed.snapshot)
        if not self._leaves_due_work:
            self._agenda.commit_due(commits)
        return commits

    def _tell_of_faults(self, snapshot: Snapshot) -> None:
        for problem in snapshot.claim_faults[:_MOST_LOGGED]:
            log.error("put back as it was: %s", problem)
        if (more := len(snapshot.claim_faults) - _MOST_LOGGED) > 0:
            log.error("put back as it was: %d more faults of claims", more)
        # each fault of the configuration is logged once, until it is mended
        before, self._logged = self._logged, tuple(dict.fromkeys(snapshot.faults))
        if before == self._logged:
            return
        for problem in self._logged:
            if problem not in before:
                log.error("not in effect: %s", problem)
        for file in sorted({old.file for old in before} - {new.file for new in self._logged}):
            log.info("%s is valid again", file or "the state repo")
        self._not_in_effect = ""
        if snapshot.faults:
            first, *_ = snapshots.problems_of(self._repository.objects, snapshot)
            self._not_in_effect = (
                f"{first.file or MAIN_BRANCH} is not in effect since commit {first.since[:10]} "
                f"({first.message}), so this was decided with the "
                f"configuration of commit {str(snapshot.configuration)[:10]}"
            )

    def _record_published(self, commits: CommitBatch) -> None:
        if commits.followed:
            log.info("%s", commits.followed)
        if commits.tells:
            self._approvals.tell_of_faults(commits.head)
        before, self.snapshot = self.snapshot, commits.head
        # without a claim or an override that has ended, the configuration of main may be valid
        if self.snapshot.state.ledger is not commits.start.state.ledger:
            self._agenda.must_judge = bool(self.snapshot.faults)
        # also true after a person's merge that needs no commit of the generator
        if self.snapshot.commit != before.commit:
            self._packs_since_tidy += 1
            if commits.start.commit != before.commit:  # people may have listed who may sign
                self._warn_if_unsigned()
            for listener in self.listeners:
                listener(self.snapshot.state.config)

    def _warn_if_unsigned(self) -> None:
        if self._repository.signer is not None or self._warned_of_signers:
            return
        if are_listed(self._repository.objects, self.snapshot.commit):
            self._warned_of_signers = True
            log.warning(
                "%s lists who may sign, but this generator has no key, so `verify` will refuse its "
                "commits, and generators will treat them as commits by a person; start the "
                "generator with --signing-key",
                ALLOWED_SIGNERS,
            )

    def _record_reached(self, *, pushed: bool = False) -> None:
        self.remote.record_reached(pushed=pushed)
        self._agenda.fetched(reached=True)

    def _record_failure(self, error: StateRepoError) -> float:
        # returns for how many seconds the remote denies all pushes; 0 if it is away
        if self._ends_soon.is_set():  # there is no retry to report
            return 0.0
        if isinstance(error, PushDenied):
            self._agenda.fetched(reached=True)
        else:
            pause = error.retry_after_s if isinstance(error, Unavailable) else 0.0
            self._agenda.fetched(reached=False, at_least_s=pause)
        return self.remote.record_failure(str(error), is_denied=isinstance(error, PushDenied))
