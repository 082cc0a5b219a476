"""The source of every view: the state at a commit, the health of releases, open proposals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Generic, TypeVar

from demandops.base.errors import DemandOpsError
from demandops.base.runtime import REAL
from demandops.cluster import rollouts
from demandops.cluster.health import (
    ClusterDomain,
    Health,
    History,
    ObjectSelector,
    Target,
    health_reader,
)
from demandops.cluster.watches import ObjectCache
from demandops.decide.override_report import Entry, override_report, override_state
from demandops.decide.planning import planner
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.planning.planner import ReleaseKey
from demandops.decide.state import State
from demandops.model.config.config import Config
from demandops.model.config.inventory import Node
from demandops.model.config.override import Override
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import Ledger, World, changes_on
from demandops.model.release import Release, ServiceRelease, claims_of
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.snapshot import Problem, Snapshot
from demandops.repo.reader import Reader
from demandops.repo.write.proposal_branch import PendingProposal
from demandops.views.rows import RANKS

# ---- the health of a release in one word ----


def word_of(status: rollouts.ReleaseStatus) -> str:
    if status.state == "unknown":
        return "unknown"
    if status.health.failing:
        return "failing"
    return {"healthy": "healthy", "reconciled": "starting", "waiting": "waiting"}[status.state]


def since_of(status: rollouts.ReleaseStatus) -> datetime | None:
    # a cluster may report no valid time
    try:  # Python 3.10 reads no "Z"
        since = datetime.fromisoformat(status.since.replace("Z", "+00:00"))
    except ValueError:
        return None
    return since if since.tzinfo else None


def worst_word(statuses: Iterable[rollouts.ReleaseStatus]) -> str:
    return min(map(word_of, statuses), key=RANKS.__getitem__, default="unknown")


# ---- the state at one commit, and with it what the clusters report ----

_UNKNOWN = rollouts.ReleaseStatus(Health("waiting"))
_Value = TypeVar("_Value")


@dataclass(frozen=True, slots=True)
class Planned:
    release: Release
    target: Target  # the Kubernetes object whose health counts as the release's
    claims: list[Claim]  # that need the release


def claims_behind(ledger: Ledger, release: Release) -> list[Claim]:
    # callers pass a ledger without suspended claims
    claims = claims_of(release, ledger)
    if not isinstance(release, ServiceRelease):
        return by_booking(claims)
    service, key = release.service, release.key
    return by_booking(c for c in claims if planner.takes(c.application, service, key))


def by_booking(claims: Iterable[Claim]) -> list[Claim]:
    return sorted(claims, key=lambda claim: (claim.booked, str(claim.subject), claim.demand))


class _Derived(Generic[_Value]):
    """A property that is computed once for a commit, whatever the clusters report meanwhile."""

    def __init__(self, compute: Callable[[Source], _Value]) -> None:
        self._compute, self._name = compute, compute.__name__

    def __get__(self, source: Source, owner: type[Source]) -> _Value:
        if self._name not in source.derived:
            source.derived[self._name] = self._compute(source)
        value: _Value = source.derived[self._name]
        return value


@dataclass(frozen=True)
class Source:
    """What every view reads: the state at a commit, and what is known about it ``now``.

    For an earlier commit, all that the clusters report is empty, as it is if none was asked.
    """

    snapshot: Snapshot = field(compare=False)
    entry: LogEntry  # the commit
    now: datetime
    # Returns a reader for the calling thread.
    reader: Callable[[], Reader] = field(compare=False)
    problems: tuple[Problem, ...] = ()
    remedy: str = ""  # how to mend a configuration that is not in effect
    is_newest: bool = True
    statuses: Mapping[str, rollouts.ReleaseStatus] = field(default_factory=dict)
    watched: frozenset[str] = frozenset()  # clusters
    proposals: tuple[PendingProposal, ...] = ()
    proposal_links: Mapping[str, str | None] = field(default_factory=dict)  # at a forge
    unread: str = ""  # why a newer state cannot be read or shown
    push_denied: str = ""  # why the node that shows the page cannot publish demands
    unreadable: Mapping[str, str] = field(default_factory=dict)  # why, by the cluster's name
    old_bootstraps: tuple[rollouts.OldBootstrap, ...] = ()
    orphans: tuple[rollouts.Orphan, ...] = ()
    # What follows from the commit alone. Sources of one commit share it.
    derived: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def read(cls, reader: Reader, snapshot: Snapshot, **more: Any) -> Source:  # noqa: ANN401
        entry = next(reader.log(str(snapshot.commit)))
        problems = snapshots.problems_of(reader.objects, snapshot)
        remedy = snapshots.how_to_mend(reader.objects, snapshot)
        own = reader.for_another_thread
        return cls(snapshot, entry, REAL.now(), own, problems, remedy, **more)

    @property
    def nodes(self) -> Mapping[str, Node]:
        """The listed nodes, and those of patterns that claims need."""
        known = self.config.nodes
        used = self.state.ledger.indexed_names("node") if self.config.node_patterns else set()
        return {**known, **{id: known[id] for id in used if id in known}}

    def taking_over(self, before: Source) -> Source:
        """Plan only what may differ from an earlier source; its other releases and rows are kept.

        To be called before anything is derived.
        """
        old, new = before.state, self.state
        # another configuration, or another override, may change every release
        if (old.config, old.overrides) != (new.config, new.overrides):
            return self
        # ledgers share the collection of an unchanged subject's claims, so comparing ids is enough
        subject_before = {id(claims): subject for subject, claims in old.ledger.claims.items()}
        subject_now = {id(claims): subject for subject, claims in new.ledger.claims.items()}
        differing = subject_before.keys() ^ subject_now.keys()
        subjects = [*dict.fromkeys(subject_before.get(id) or subject_now[id] for id in differing)]
        changes = changes_on(old.ledger, new.ledger, subjects)
        keys: set[ReleaseKey] = {*planner.affected_keys(old, new, changes)}
        # what is planned as before may be needed by other claims
        needing: dict[ReleaseKey, list[Claim]] = {}
        for change in changes:
            was, now = before.active.ledger.get(change.key), self.active.ledger.get(change.key)
            if was:
                for key in planner.keys_of_claims(before.active, [was]):
                    needing.setdefault(key, [])
            if now:
                for key in planner.keys_of_claims(self.active, [now]):
                    needing.setdefault(key, []).append(now)
                    # the views show requesters, but `affected_keys` omits a release whose file
                    # stays the same although its requesters changed
                    if was and was.requesters != now.requesters:
                        keys.add(key)
        planned, changed = {**before.planned}, {change.key for change in changes}
        for key, claims in needing.items():
            if earlier := planned.get(key):
                kept = [claim for claim in earlier.claims if claim.key not in changed]
                planned[key] = replace(earlier, claims=by_booking([*kept, *claims]))
        for key in keys:
            planned.pop(key, None)
            if (anew := self._plan(key)) or planner.denied_release(new, key):
                planned[key] = anew
        self.derived["planned"] = planned
        self.rows.update((name, (None, rows)) for name, (_, rows) in before.rows.items())
        return self

    @property
    def commit(self) -> str:
        return str(self.snapshot.commit)

    @property
    def state(self) -> State:
        return self.snapshot.state

    @property
    def config(self) -> Config:
        return self.snapshot.state.config

    @_Derived
    def active(self) -> World:
        return without_suspended(self.state)

    @_Derived
    def rows(self) -> dict[str, tuple[object, Mapping[str, tuple[tuple[Any, ...], Any]]]]:
        # For each list that was shown, by its name: the status of each release when the rows were
        # made, or None if they are of an earlier commit; and the values and the row of each entry.
        return {}

    def _plan(self, key: ReleaseKey) -> Planned | None:
        if (release := planner.plan(self.state, key)) is None:
            return None
        target = rollouts.target_of(release, self.config.repo_settings)
        return Planned(release, target, claims_behind(self.active.ledger, release))

    @_Derived
    def planned(self) -> dict[ReleaseKey, Planned | None]:
        # None if the release is denied, if all claims that need it are suspended, or if the client
        # of a connection carries no topic
        return {key: self._plan(key) for key in planner.all_keys(self.state)}

    @_Derived
    def running(self) -> list[Planned]:
        running = filter(None, self.planned.values())
        return sorted(running, key=lambda each: (each.target.domain.cluster, each.target.name))

    @_Derived
    def denied(self) -> list[tuple[Release, Override]]:
        keys = (key for key, planned in self.planned.items() if planned is None)
        return [denied for key in keys if (denied := planner.denied_release(self.state, key))]

    @_Derived
    def releases(self) -> dict[str, Release]:
        return {planned.release.name: planned.release for planned in self.running}

    @_Derived
    def overrides(self) -> list[Entry]:
        return [
            replace(entry, state=override_state(entry, self.state, self.not_rendered))
            for entry in override_report(self.state, self.now)
        ]

    @property
    def not_rendered(self) -> frozenset[str]:
        """The files that a generator has yet to write or remove, after a person's commit."""
        if "not_rendered" not in self.derived:
            try:
                self.derived["not_rendered"] = self.reader().not_rendered(self.snapshot)
            except DemandOpsError:  # the state repo is away, which the views tell
                return frozenset()
        found: frozenset[str] = self.derived["not_rendered"]
        return found

    @_Derived
    def claims_of_releases(self) -> dict[str, list[Claim]]:
        return {planned.target.name: planned.claims for planned in self.running}

    @_Derived
    def releases_of_demands(self) -> dict[str, list[str]]:
        releases: dict[str, list[str]] = {}
        for name, claims in self.claims_of_releases.items():
            for demand in dict.fromkeys(claim.demand for claim in claims):
                releases.setdefault(demand, []).append(name)
        return releases

    @_Derived
    def claims_of_demands(self) -> dict[str, list[Claim]]:
        claims_of: dict[str, list[Claim]] = {}
        for claim in self.state.ledger:
            claims_of.setdefault(claim.demand, []).append(claim)
        for claims in claims_of.values():
            if len(claims) > 1:
                claims.sort(key=lambda claim: str(claim.subject))
        return claims_of

    @_Derived
    def _last_changes(self) -> dict[str, LogEntry | None]:
        return {}

    def last_change(self, path: str) -> LogEntry | None:
        """Return the newest commit that changed a path; each look-up walks through the history."""
        if path not in self._last_changes:
            changes = self.reader().log(self.commit, path) if path else iter(())
            self._last_changes[path] = next(changes, None)
        return self._last_changes[path]

    def with_reports(
        self, caches: Mapping[str, ObjectCache], history: History, changed: rollouts.ChangedPaths
    ) -> Source:
        """Add what clusters report, as read into their caches."""
        targets, domains = [planned.target for planned in self.running], self.domains
        files = self.reader().file_reader(self.commit)
        reported = rollouts.statuses(targets, self.commit, caches, history, changed)
        unread = {
            name: cache.why_unknown(self.watched_objects.get(name, ()))
            for name, cache in caches.items()
        }
        return replace(
            self,
            statuses={target.name: each for target, each in zip(targets, reported, strict=True)},
            watched=frozenset(caches),
            unreadable={name: reason for name, reason in sorted(unread.items()) if reason},
            old_bootstraps=tuple(rollouts.old_bootstraps(domains, caches, files)),
            orphans=tuple(rollouts.orphans(domains, targets, self.commit, caches, history)),
        )

    @_Derived
    def domains(self) -> list[ClusterDomain]:
        return rollouts.domains_of_state(self.state)

    @_Derived
    def watched_objects(self) -> dict[str, list[ObjectSelector]]:
        """The objects that tell the health of the releases, by cluster."""
        wanted: dict[str, dict[ObjectSelector, None]] = {}
        used = (planned.target.domain for planned in self.running)
        for domain in dict.fromkeys((*used, *self.domains)):
            watched = health_reader(domain).objects_to_watch(domain)
            wanted.setdefault(domain.cluster, {}).update(dict.fromkeys(watched))
        return {cluster: [*selectors] for cluster, selectors in wanted.items()}

    def status(self, release: str) -> rollouts.ReleaseStatus:
        return self.statuses.get(release, _UNKNOWN)

    @property
    def unwatched(self) -> list[str]:
        used = {planned.target.domain.cluster for planned in self.running}
        return sorted(used - self.watched)
