"""Follows the state repo: the newest situation, any earlier one, and the history.

One thread fetches new commits and publishes each new situation; the threads of requests read it.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import islice

from demandops.cluster.bootstrap_status import OldBootstrap
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.release_status import ReleaseStatus
from demandops.errors import DemandOpsError
from demandops.quoting import one_line
from demandops.runtime import REAL, Runtime
from demandops.service import rollout_targets
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load.snapshot import Progress, Snapshot
from demandops.staterepo.reader import Reader
from demandops.staterepo.write.proposal_branch import pending_proposals
from demandops.web.cluster_watch import ClusterWatch
from demandops.web.situation import Commit, HealthChange, Moment, Situation

log = logging.getLogger("demandops")

MOST_COMMITS = 5_000
"""How many commits of the history the page knows; older ones are left out."""

_LOOK_S = 0.2
"""The pause between checks of a repository on this disk; a check reads one file."""
_MOST_OF_TIME = 4
"""The follower's pause as a multiple of its last work, so that it uses little processor time."""
_MOST_MOMENTS = 8


class Follower:
    """The newest situation of a state repo, and earlier ones."""

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
            reader: the open state repo; belongs to the follower from now on.
            clusters: how to reach the clusters; one without a kubeconfig is not watched.
            interval: seconds between two fetches of a remote; 0: only after :meth:`wake`.
            progress: called while the ledger is loaded.
            runtime: provides the time and the threads.

        Raises:
            StateRepoError, InvalidInput: if the state cannot be read.
        """
        self._reader, self._runtime = reader, runtime
        self._interval = _LOOK_S if reader.repository.always_current else interval or None
        self._wake, self.closed = runtime.event(), runtime.event()
        self._watch = ClusterWatch(clusters, self._wake.set, runtime)
        self._moments: dict[str, Moment] = {}
        self._loading = runtime.lock()
        self.version = 0
        """Grows with each new situation."""
        self.history: tuple[Commit, ...] = ()
        """The newest commits, newest first."""
        self._newest = self._situation_at(self._first_moment(progress))
        self._thread = runtime.keep_running("page", self._run)

    @property
    def newest(self) -> Situation:
        """The newest situation, as of now."""
        return replace(self._newest, now=self._runtime.now())

    @property
    def health_changes(self) -> tuple[HealthChange, ...]:
        """The changes of health that were seen, oldest first."""
        return self._watch.changes

    def reader(self) -> Reader:
        """Return a reader for the calling thread."""
        return self._reader.beside()

    def at(self, revision: str) -> Situation:
        """Return the situation at a commit or a time; without a revision the newest.

        Raises:
            InvalidInput, StateRepoError: if there is no such commit, or it is not valid.
        """
        newest = self.newest
        if not revision:
            return newest
        reader = self.reader()
        commit = reader.commit(revision)
        if commit == newest.moment.commit:
            return newest
        with self._loading:  # one commit at a time, because loading may take seconds
            moment = self._moments.pop(commit, None) or _moment(
                reader, reader.last_valid_snapshot(commit)
            )
            self._moments[commit] = moment
            if len(self._moments) > _MOST_MOMENTS:
                del self._moments[next(iter(self._moments))]
        return Situation(moment, newest.now, is_newest=False)

    def last_change(self, moment: Moment, path: str) -> LogEntry | None:
        """Return the newest commit up to a moment that changed a file, if there is one."""
        if path not in moment.last_changes:
            found = self.reader().log(moment.commit, path) if path else iter(())
            moment.last_changes[path] = next(found, None)
        return moment.last_changes[path]

    def not_rendered(self, moment: Moment) -> frozenset[str]:
        """Return the generated files that a generator has yet to write or remove at a moment.

        Return no files while the state repo cannot be reached.
        """
        if moment.not_rendered is None:
            try:
                moment.not_rendered = self.reader().not_rendered(moment.snapshot)
            except DemandOpsError:
                return frozenset()
        return moment.not_rendered

    def wake(self) -> None:
        """Check for a new commit now; any thread may call it."""
        self._wake.set()

    def close(self) -> None:
        """Stop following."""
        self.closed.set()
        self._wake.set()
        self._thread.join()
        self._watch.close()
        self._reader.close()

    def _first_moment(self, progress: Progress) -> Moment:
        snapshot = self._reader.last_valid_snapshot(self._reader.commit(), progress)
        return _moment(self._reader, snapshot)

    def _run(self) -> None:
        while not self.closed.is_set():
            self._wake.wait(self._interval)
            self._wake.clear()
            began, version = self._runtime.monotonic(), self.version
            self._look()
            if self.version != version:
                self.closed.wait(min(1.0, _MOST_OF_TIME * (self._runtime.monotonic() - began)))

    def _look(self) -> None:
        """Read new commits and statuses; publish a new situation if something changed."""
        known = self._newest
        try:
            commit, moment = self._reader.refresh(), known.moment
            if commit != moment.commit:
                snapshot = self._reader.snapshot_after(moment.snapshot)
                moment = _moment(self._reader, snapshot)
                moment.take_over(known.moment)
            found = self._situation_at(moment)
        except DemandOpsError as error:
            found = replace(known, unread=one_line(str(error).replace("\n", "; ")))
        except Exception as error:  # a fault of the page must not stop the node in its process
            if not known.unread:
                log.exception("the page cannot follow the state repo")
            found = replace(known, unread=f"a fault of the program: {one_line(repr(error))}")
        if replace(found, now=known.now) != known:
            self._newest = found
            self.version += 1

    def _situation_at(self, moment: Moment) -> Situation:
        """Return the situation at a moment, with the newest statuses, proposals and history."""
        self._read_history(moment.commit)
        statuses: Mapping[str, ReleaseStatus] = {}
        old: tuple[OldBootstrap, ...] = ()
        if self._watch.clusters:
            wanted = [target for _, target in moment.targets]
            repository = self._reader.repository
            statuses = self._watch.statuses(wanted, moment.commit, repository)
            domains = rollout_targets.domains_of_state(moment.state)
            old = self._watch.old_bootstraps(domains, self._reader.file_reader(moment.commit))
        return Situation(
            moment,
            self._runtime.now(),
            statuses=statuses,
            watched=self._watch.clusters,
            proposals=tuple(pending_proposals(self._reader.repository)),
            old_bootstraps=old,
        )

    def _read_history(self, tip: str) -> None:
        known = self.history[0].entry.commit if self.history else ""
        if tip == known:
            return
        new = None
        if known and self._reader.repository.includes(tip, known):
            with suppress(DemandOpsError):
                new = list(islice(self._reader.log(f"{known}..{tip}"), MOST_COMMITS))
        before = self.history
        if new is None:  # the first time, or after the history was rewritten
            new, before = list(islice(self._reader.log(tip), MOST_COMMITS)), ()
        added = tuple(Commit(entry, self._reader.changed_roots(entry.commit)) for entry in new)
        self.history = (added + before)[:MOST_COMMITS]


def _moment(reader: Reader, snapshot: Snapshot) -> Moment:
    entry = next(reader.log(str(snapshot.commit)))
    return Moment(snapshot, entry, reader.problems_of(snapshot))
