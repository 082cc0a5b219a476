"""Follows the state repo and the clusters, and provides what the page shows."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from itertools import islice

from demandops.base.errors import DemandOpsError
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL
from demandops.cluster import rollouts
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.health import ClusterDomain, health_reader
from demandops.cluster.object_cache import object_caches
from demandops.cluster.release_status import old_bootstraps, orphans, statuses
from demandops.repo.git.repository import reading
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.load.snapshot import Progress, Snapshot
from demandops.repo.reader import Reader
from demandops.repo.write.proposal_branch import pending_proposals
from demandops.web.situation import Commit, CommitState, HealthChange, Situation, word_of

# ---- the releases on their clusters, and the changes of their health ----

# How many changes of health are kept. They are in memory only, because the page writes nothing.
_KEPT = 2_000


class ClusterWatch:
    # only one thread at a time may use a watch, but any thread may read `changes`
    def __init__(
        self, clusters: Mapping[str, ClusterAccess], on_change: Callable[[], None]
    ) -> None:
        self._caches = object_caches(clusters, on_change, REAL)
        self.clusters = frozenset(self._caches)
        self._domains = set[ClusterDomain]()
        # The word for the health of each release, and since when it is not healthy.
        self._seen: dict[str, tuple[str, float | None]] = {}
        self._changes = deque[HealthChange](maxlen=_KEPT)

    @property
    def changes(self) -> tuple[HealthChange, ...]:
        # any thread may read this; to iterate would fail if the follower appended meanwhile
        return tuple(self._changes.copy())

    def with_reports(self, situation: Situation, reader: Reader) -> Situation:
        commit_state, caches, repository = situation.commit_state, self._caches, reader.repository
        targets = [target for _, target in commit_state.targets]
        domains = rollouts.domains_of_state(commit_state.state)
        for domain in dict.fromkeys((*(target.domain for target in targets), *domains)):
            if domain.cluster in caches and domain not in self._domains:
                self._domains.add(domain)
                caches[domain.cluster].watch(health_reader(domain).objects_to_watch(domain))
        commit = commit_state.commit
        # Health is judged by the file that the cluster has applied. Judged by the newest commit,
        # everything would be `waiting` for seconds after each commit.
        reported = statuses(targets, commit, caches, repository, repository.changed_paths)
        status_of = {target.name: status for target, status in zip(targets, reported, strict=True)}
        at = REAL.monotonic()
        for name, status in status_of.items():
            (before, began), after = self._seen.get(name, ("", None)), word_of(status)
            if before == after:
                continue
            lasted = None
            if after == "healthy":
                lasted, began = None if began is None else at - began, None
            elif after != "unknown" and began is None:
                began = at
            self._seen[name] = after, began
            if before:  # the first health that a cluster reports of a release is no change
                reason = status.health.reason
                change = HealthChange(REAL.now(), name, before, after, reason, lasted)
                self._changes.append(change)
        self._seen = {name: self._seen[name] for name in status_of}
        return replace(
            situation,
            statuses=status_of,
            old_bootstraps=tuple(old_bootstraps(domains, caches, reader.file_reader(commit))),
            orphans=tuple(orphans(domains, targets, commit, caches, repository)),
        )

    def close(self) -> None:
        for cache in self._caches.values():
            cache.close()


# ---- the state repo, and its newest commits ----
#
# One thread fetches new commits and publishes each new situation. The threads that answer requests
# read the published situation.

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
        push_denied: Callable[[], str] = lambda: "",
    ) -> None:
        # `close` closes ``reader``. ``interval`` has the seconds between fetches from a remote; at
        # 0, the follower fetches only after `wake` or a change on a cluster.
        self._reader = reader
        self._interval = _LOOK_S if reader.repository.always_current else interval or None
        self._wake, self.closed = REAL.event(), REAL.event()
        self._push_denied = push_denied
        self._watch = ClusterWatch(clusters, self._wake.set)
        self._commit_states: dict[str, CommitState] = {}
        self._loading = REAL.lock()
        # Browsers fetch the page again when this number changes.
        self.version = 0
        # The newest commits, at most `MOST_COMMITS`, newest first.
        self.history: tuple[Commit, ...] = ()
        snapshot = reader.snapshot(progress=progress)
        self._newest = self._situation_at(_commit_state(reader, snapshot))
        self._thread = REAL.keep_running("page", self._run)

    @property
    def newest(self) -> Situation:
        return replace(self._newest, now=REAL.now())

    @property
    def health_changes(self) -> tuple[HealthChange, ...]:
        return self._watch.changes

    def reader(self) -> Reader:
        return self._reader.for_another_thread()

    def reading(self) -> AbstractContextManager[None]:
        # raises StateRepoError if an object is missing or damaged
        repository = self._reader.repository
        return reading(repository.address, repository.objects)

    def at(self, revision: str) -> Situation:
        newest = self.newest
        if not revision:
            return newest
        reader = self.reader()
        commit = reader.commit(revision)
        if commit == newest.commit_state.commit:
            return newest
        with self._loading:  # load only one commit at a time, because loading may take seconds
            commit_state = self._commit_states.pop(commit, None) or _commit_state(
                reader, reader.snapshot(commit)
            )
            # added again at the end, so that the state that was not used for longest is dropped
            self._commit_states[commit] = commit_state
            if len(self._commit_states) > _MOST_COMMIT_STATES:
                del self._commit_states[next(iter(self._commit_states))]
        return Situation(commit_state, newest.now, is_newest=False)

    def last_change(self, commit_state: CommitState, path: str) -> LogEntry | None:
        if path not in commit_state.last_changes:
            changes = self.reader().log(commit_state.commit, path) if path else iter(())
            commit_state.last_changes[path] = next(changes, None)
        return commit_state.last_changes[path]

    def not_rendered(self, commit_state: CommitState) -> frozenset[str]:
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
            began, before = REAL.monotonic(), self._newest
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
            now = replace(now, push_denied=self._push_denied())
            if replace(now, now=before.now) != before:
                self._newest = now
                self.version += 1
                # The pause keeps the load of the processor low when commits come all the time.
                self.closed.wait(min(1.0, _PAUSE_FACTOR * (REAL.monotonic() - began)))

    def _situation_at(self, commit_state: CommitState) -> Situation:
        watch, repository, commit = self._watch, self._reader.repository, commit_state.commit
        last = self.history[0].entry.commit if self.history else ""
        if commit != last:
            new, before = None, self.history
            if last and repository.includes(commit, last):
                with suppress(DemandOpsError):
                    new = list(islice(self._reader.log(f"{last}..{commit}"), MOST_COMMITS))
            if new is None:  # the first time, or somebody has rewritten the history
                new, before = list(islice(self._reader.log(commit), MOST_COMMITS)), ()
            added = tuple(Commit(entry, self._reader.changed_roots(entry.commit)) for entry in new)
            self.history = (added + before)[:MOST_COMMITS]
        situation = Situation(
            commit_state,
            REAL.now(),
            watched=watch.clusters,
            proposals=tuple(pending_proposals(repository)),
        )
        return watch.with_reports(situation, self._reader) if watch.clusters else situation


def _commit_state(reader: Reader, snapshot: Snapshot) -> CommitState:
    entry = next(reader.log(str(snapshot.commit)))
    problems = reader.problems_of(snapshot)
    return CommitState(snapshot, entry, problems, reader.how_to_mend(snapshot))
