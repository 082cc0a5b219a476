"""Follows the state repo and the clusters, and provides what the page shows."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from itertools import islice

from demandops.base.errors import DemandOpsError
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL, log
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.watches import object_caches
from demandops.repo.git.repository import reading
from demandops.repo.load.snapshot import Progress
from demandops.repo.reader import Reader
from demandops.repo.write.proposal_branch import pending_proposals
from demandops.views.source import Source, word_of
from demandops.views.vocabulary import commit_data
from demandops.web import time_line
from demandops.web.time_line import Event

# How many of the newest commits the time line shows.
MOST_COMMITS = 5_000

# How many changes of health are kept. They are in memory only, because the page writes nothing.
_MOST_CHANGES = 2_000

# The pause in seconds between checks of a local repository, which cost little.
_LOOK_S = 0.2
# After a new situation, the follower pauses this many times as long as the computation took, but
# at most one second.
_PAUSE_FACTOR = 4
# How many earlier states are kept for visitors who look back; each holds a whole ledger.
_MOST_EARLIER = 8


class Follower:
    # One thread fetches new commits and publishes each new situation. The threads that answer
    # requests read the published situation.

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
        self._caches = object_caches(clusters, self._wake.set, REAL)
        self._words: dict[str, str] = {}  # for the health of each release, as last seen
        self._changes = deque[Event](maxlen=_MOST_CHANGES)
        self._earlier: dict[str, Source] = {}
        self._loading = REAL.lock()
        # Browsers fetch the page again when this number changes.
        self.version = 0
        # The newest commits, at most `MOST_COMMITS`, newest first.
        self.history: tuple[Event, ...] = ()
        snapshot = reader.snapshot(progress=progress)
        self._newest = self._with_reports(Source.read(reader, snapshot))
        self._thread = REAL.keep_running("page", self._run)

    @property
    def newest(self) -> Source:
        return replace(self._newest, now=REAL.now())

    @property
    def health_changes(self) -> tuple[Event, ...]:
        # to iterate would fail if the follower's thread appended meanwhile
        return tuple(self._changes.copy())

    def reading(self) -> AbstractContextManager[None]:
        # raises StateRepoError if an object is missing or damaged
        repository = self._reader.repository
        return reading(repository.address, repository.objects)

    def at(self, revision: str) -> Source:
        newest = self.newest
        if not revision:
            return newest
        reader = self._reader.for_another_thread()
        commit = reader.commit(revision)
        if commit == newest.commit:
            return newest
        with self._loading:  # load only one commit at a time, because loading may take seconds
            source = self._earlier.pop(commit, None) or Source.read(
                reader, reader.snapshot(commit), is_newest=False
            )
            # added again at the end, so that the source that was not used for longest is dropped
            self._earlier[commit] = source
            if len(self._earlier) > _MOST_EARLIER:
                del self._earlier[next(iter(self._earlier))]
        return replace(source, now=newest.now)

    def wake(self) -> None:
        self._wake.set()

    def close(self) -> None:
        self.closed.set()
        self._wake.set()
        self._thread.join()
        for cache in self._caches.values():
            cache.close()
        self._reader.close()

    def _run(self) -> None:
        while not self.closed.is_set():
            self._wake.wait(self._interval)
            self._wake.clear()
            began, before = REAL.monotonic(), self._newest
            try:
                commit, source = self._reader.refresh(), before
                with self.reading():
                    if commit != before.commit:
                        snapshot = self._reader.snapshot_after(before.snapshot)
                        # only the releases that new claims affect are planned
                        source = Source.read(self._reader, snapshot).taking_over(before)
                    now = self._with_reports(source)
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

    def _with_reports(self, source: Source) -> Source:
        repository, commit = self._reader.repository, source.commit
        last = self.history[0].commit if self.history else ""
        if commit != last:
            new, before = None, self.history
            if last and repository.includes(commit, last):
                with suppress(DemandOpsError):
                    new = list(islice(self._reader.log(f"{last}..{commit}"), MOST_COMMITS))
            if new is None:  # the first time, or somebody has rewritten the history
                new, before = list(islice(self._reader.log(commit), MOST_COMMITS)), ()
            lanes = (time_line.lane_of(e, self._reader.changed_roots(e.commit)) for e in new)
            added = tuple(map(time_line.of_commit, map(commit_data, new), lanes))
            self.history = (added + before)[:MOST_COMMITS]
        source = replace(
            source,
            now=REAL.now(),
            watched=frozenset(self._caches),
            proposals=tuple(pending_proposals(repository)),
            unread="",
            push_denied="",
        )
        if not self._caches:
            return source
        for cluster, objects in source.watched_objects.items():
            if cluster in self._caches:
                self._caches[cluster].watch(objects)
        # Health is judged by the file that the cluster has applied. Judged by the newest commit,
        # everything would be `waiting` for seconds after each commit.
        source = source.with_reports(self._caches, repository, repository.changed_paths)
        words = {name: word_of(status) for name, status in source.statuses.items()}
        for name, after in words.items():
            earlier = self._words.get(name)
            if earlier and earlier != after:  # the first health that a cluster reports is no change
                reason = source.statuses[name].health.reason
                self._changes.append(time_line.of_health(name, earlier, after, reason))
        self._words = words
        return source
