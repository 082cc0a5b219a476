"""Follows the state repo, and provides what the page shows.

A situation is the state at a commit, with the reports of the clusters (:class:`Situation`). The
page shows the newest situation, situations at earlier commits, and the newest commits.

One thread fetches new commits and publishes each new situation. The threads that answer requests
read the published situation.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from itertools import islice

from demandops.cluster.clusters_file import ClusterAccess
from demandops.errors import DemandOpsError
from demandops.quoting import one_line
from demandops.runtime import REAL, Runtime
from demandops.service import rollout_targets
from demandops.staterepo.git.repository import reading
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load.snapshot import Progress, Snapshot
from demandops.staterepo.reader import Reader
from demandops.staterepo.write.proposal_branch import pending_proposals
from demandops.web.cluster_watch import ClusterWatch
from demandops.web.situation import Commit, CommitState, HealthChange, Situation

log = logging.getLogger("demandops")

# How many of the newest commits the time line and the rates show.
MOST_COMMITS = 5_000

# The pause in seconds between checks of a local repository, which cost little.
_LOOK_S = 0.2
# After a new situation, the follower pauses this many times as long as the computation took, but
# at most one second.
_PAUSE_FACTOR = 4
# How many earlier states are kept for visitors who look back; each holds a whole ledger.
_MOST_COMMIT_STATES = 8


class Follower:
    def __init__(
        self,
        reader: Reader,
        clusters: Mapping[str, ClusterAccess],
        interval: float,
        *,
        progress: Progress = lambda done, total: None,
        runtime: Runtime = REAL,
    ) -> None:
        """Read the newest state and follow the state repo.

        Args:
            reader: the open state repo; :meth:`close` of the follower closes it.
            clusters: how to reach the clusters; a cluster without a kubeconfig is not watched.
            interval: seconds between fetches from a remote. With 0, the follower fetches only after
                :meth:`wake` or a change on a cluster.
            progress: called while the ledger is loaded.
            runtime: provides the time and the threads.
        """
        self._reader, self._runtime = reader, runtime
        # without an interval, the follower waits until `wake`
        self._interval = _LOOK_S if reader.repository.always_current else interval or None
        self._wake, self.closed = runtime.event(), runtime.event()
        self._watch = ClusterWatch(clusters, self._wake.set, runtime)
        self._commit_states: dict[str, CommitState] = {}
        self._loading = runtime.lock()
        # Browsers fetch the page again when this number changes.
        self.version = 0
        # The newest commits, at most `MOST_COMMITS`, newest first.
        self.history: tuple[Commit, ...] = ()
        snapshot = reader.last_valid_snapshot(reader.commit(), progress)
        self._newest = self._situation_at(_commit_state(reader, snapshot))
        self._thread = runtime.keep_running("page", self._run)

    @property
    def newest(self) -> Situation:
        return replace(self._newest, now=self._runtime.now())

    @property
    def health_changes(self) -> tuple[HealthChange, ...]:
        return self._watch.changes

    def reader(self) -> Reader:
        """Return a reader of the state repo for the calling thread."""
        return self._reader.for_another_thread()

    def reading(self) -> AbstractContextManager[None]:
        """Return a context that raises StateRepoError if an object is missing or damaged."""
        repository = self._reader.repository
        return reading(repository.address, repository.objects)

    def at(self, revision: str) -> Situation:
        """Return the situation at a commit or time; the newest if ``revision`` is empty.

        The situation at an earlier commit has neither health nor proposals.
        """
        newest = self.newest
        if not revision:
            return newest
        reader = self.reader()
        commit = reader.commit(revision)
        if commit == newest.commit_state.commit:
            return newest
        with self._loading:  # load only one commit at a time, because loading may take seconds
            commit_state = self._commit_states.pop(commit, None) or _commit_state(
                reader, reader.last_valid_snapshot(commit)
            )
            # added again at the end, so that the state that was not used for longest is dropped
            self._commit_states[commit] = commit_state
            if len(self._commit_states) > _MOST_COMMIT_STATES:
                del self._commit_states[next(iter(self._commit_states))]
        return Situation(commit_state, newest.now, is_newest=False)

    def last_change(self, commit_state: CommitState, path: str) -> LogEntry | None:
        """Return the newest commit that changed a file or folder, up to that of ``commit_state``.

        Return None if none changed it, or if ``path`` is empty.
        """
        if path not in commit_state.last_changes:
            changes = self.reader().log(commit_state.commit, path) if path else iter(())
            commit_state.last_changes[path] = next(changes, None)
        return commit_state.last_changes[path]

    def not_rendered(self, commit_state: CommitState) -> frozenset[str]:
        """Return the generated files that a generator must still write or remove after a commit.

        Return none if the state of the commit cannot be read or rendered.
        """
        if commit_state.not_rendered is None:
            try:
                commit_state.not_rendered = self.reader().not_rendered(commit_state.snapshot)
            except DemandOpsError:
                return frozenset()
        return commit_state.not_rendered

    def wake(self) -> None:
        self._wake.set()

    def close(self) -> None:
        self.closed.set()
        self._wake.set()
        self._thread.join()
        self._watch.close()
        self._reader.close()

    def _run(self) -> None:
        while not self.closed.is_set():
            self._wake.wait(self._interval)
            self._wake.clear()
            began, before = self._runtime.monotonic(), self._newest
            try:
                commit, commit_state = self._reader.refresh(), before.commit_state
                with self.reading():
                    if commit != commit_state.commit:
                        snapshot = self._reader.snapshot_after(commit_state.snapshot)
                        commit_state = _commit_state(self._reader, snapshot)
                        # so that only the releases that new claims affect are planned
                        commit_state.take_over(before.commit_state)
                    now = self._situation_at(commit_state)
            except DemandOpsError as error:
                now = replace(before, unread=one_line(str(error).replace("\n", "; ")))
            except Exception as error:  # the page must show that it does not follow any more
                if not before.unread:
                    log.exception("the page cannot follow the state repo")
                now = replace(before, unread=f"a fault of the program: {one_line(repr(error))}")
            if replace(now, now=before.now) != before:
                self._newest = now
                self.version += 1
                # The pause keeps the load of the processor low when commits come all the time.
                self.closed.wait(min(1.0, _PAUSE_FACTOR * (self._runtime.monotonic() - began)))

    def _situation_at(self, commit_state: CommitState) -> Situation:
        self._read_history(commit_state.commit)
        watch, repository, commit = self._watch, self._reader.repository, commit_state.commit
        situation = Situation(
            commit_state,
            self._runtime.now(),
            watched=watch.clusters,
            proposals=tuple(pending_proposals(repository)),
        )
        if not watch.clusters:
            return situation
        targets = [target for _, target in commit_state.targets]
        domains = rollout_targets.domains_of_state(commit_state.state)
        return replace(
            situation,
            statuses=watch.statuses(targets, commit, repository),
            old_bootstraps=watch.old_bootstraps(domains, self._reader.file_reader(commit)),
            orphans=watch.orphans(domains, targets, commit, repository),
        )

    def _read_history(self, tip: str) -> None:
        last = self.history[0].entry.commit if self.history else ""
        if tip == last:
            return
        new = None
        if last and self._reader.repository.includes(tip, last):
            with suppress(DemandOpsError):
                new = list(islice(self._reader.log(f"{last}..{tip}"), MOST_COMMITS))
        before = self.history
        if new is None:  # the first time, or somebody has rewritten the history
            new, before = list(islice(self._reader.log(tip), MOST_COMMITS)), ()
        added = tuple(Commit(entry, self._reader.changed_roots(entry.commit)) for entry in new)
        self.history = (added + before)[:MOST_COMMITS]


def _commit_state(reader: Reader, snapshot: Snapshot) -> CommitState:
    entry = next(reader.log(str(snapshot.commit)))
    return CommitState(snapshot, entry, reader.problems_of(snapshot))
