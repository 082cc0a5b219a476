"""What the page shows: the state at a commit, the health of releases and the open proposals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property
from typing import Any

from demandops.base.naming import Subject, SubjectKind
from demandops.cluster import rollouts
from demandops.cluster.health import Health, Target
from demandops.cluster.release_status import OldBootstrap, Orphan, ReleaseStatus
from demandops.decide.planning import release_keys
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.planning.planner import denied_release, plan
from demandops.decide.planning.release_keys import ReleaseKey
from demandops.model.config.override import Override
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import World, changes_on
from demandops.model.release import Release, ServiceRelease
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.load.snapshot import Problem, Snapshot
from demandops.repo.write.proposal_branch import PendingProposal
from demandops.views import release_causes
from demandops.views.release_causes import Entry, override_report

# ---- the health of a release in one word ----

# The words for a health, each with its color on the page, from the worst to the best health.
WORDS = {
    "failing": "bad",
    "waiting": "busy",
    "starting": "busy",
    "unknown": "none",
    "healthy": "good",
}

# The index of each word in `WORDS`; a lower index means worse health.
RANKS = {word: float(place) for place, word in enumerate(WORDS)}


def word_of(status: ReleaseStatus) -> str:
    if status.state == "unknown":
        return "unknown"
    if status.health.failing:
        return "failing"
    return {"healthy": "healthy", "reconciled": "starting", "waiting": "waiting"}[status.state]


def since_of(status: ReleaseStatus) -> datetime | None:
    # a cluster may report no valid time
    try:  # Python 3.10 reads no "Z"
        since = datetime.fromisoformat(status.since.replace("Z", "+00:00"))
    except ValueError:
        return None
    return since if since.tzinfo else None


def worst_word(statuses: Iterable[ReleaseStatus]) -> str:
    return min(map(word_of, statuses), key=RANKS.__getitem__, default="unknown")


# ---- the state at one commit, and with it what the clusters report ----

_UNKNOWN = ReleaseStatus(Health("waiting"))


@dataclass(frozen=True, slots=True)
class Planned:
    release: Release
    target: Target  # the Kubernetes object whose health counts as the release's
    claims: list[Claim]  # that need the release


class CommitState:
    def __init__(
        self, snapshot: Snapshot, entry: LogEntry, problems: tuple[Problem, ...], remedy: str = ""
    ) -> None:
        # ``remedy`` tells how to mend a configuration that is not in effect
        self.snapshot, self.entry, self.problems, self.remedy = snapshot, entry, problems, remedy
        self.commit, self.state = str(snapshot.commit), snapshot.state
        self.config = snapshot.state.config
        # For each list that was shown, by its name: the status of each release when the rows were
        # made, or None if they are of an earlier commit; and the values and the row of each entry.
        self.rows: dict[str, tuple[object, Mapping[str, tuple[tuple[Any, ...], Any]]]] = {}
        self._entries: list[Entry] | None = None
        # The newest commit that changed a path; None if none did. Paths are looked up when asked
        # for, because each look-up walks through the history.
        self.last_changes: dict[str, LogEntry | None] = {}
        # The files that a generator must still write or remove; None until they are looked up.
        self.not_rendered: frozenset[str] | None = None

    @cached_property
    def active(self) -> World:
        return without_suspended(self.state)

    def take_over(self, before: CommitState) -> None:
        # Its releases and rows are kept, and what may differ is planned anew. To be called before
        # any other method, because computed attributes are kept.
        old, new = before.state, self.state
        # another configuration, or another override, may change every release
        if (old.config, old.overrides) != (new.config, new.overrides):
            return
        # ledgers share the collection of an unchanged subject's claims, so comparing ids is enough
        subject_before = {id(claims): subject for subject, claims in old.ledger.claims.items()}
        subject_now = {id(claims): subject for subject, claims in new.ledger.claims.items()}
        differing = subject_before.keys() ^ subject_now.keys()
        subjects = [*dict.fromkeys(subject_before.get(id) or subject_now[id] for id in differing)]
        changes = changes_on(old.ledger, new.ledger, subjects)
        keys: set[ReleaseKey] = {*release_keys.affected_keys(old, new, changes)}
        for was, now in ((change.before, change.after) for change in changes):
            # the page shows requesters, but `affected_keys` omits a release whose file stays the
            # same although its requesters changed
            if was and now and was.requesters != now.requesters:
                keys.update(release_keys.keys_of_claims(self.active, [now]))
        planned = before.planned | dict(self._with_other_claims(before, subjects))
        for key in keys:
            planned.pop(key, None)
            if (release := self._plan(key)) or denied_release(new, key):
                planned[key] = release
        self.planned = planned
        self.rows = {name: (None, rows) for name, (_, rows) in before.rows.items()}

    def _with_other_claims(
        self, before: CommitState, subjects: Iterable[Subject]
    ) -> Iterator[tuple[ReleaseKey, Planned]]:
        gone: set[int] = set()
        fresh: dict[SubjectKind, dict[str, list[Claim]]] = {kind: {} for kind in SubjectKind}
        for subject in subjects:
            was, now = (state.active.ledger.claims_on(subject) for state in (before, self))
            gone |= {id(claim) for claim in was} - {id(claim) for claim in now}
            before_ids = {id(claim) for claim in was}
            fresh[subject.kind][subject.id] = [
                claim for claim in now if id(claim) not in before_ids
            ]
        for key, planned in before.planned.items():
            if planned is None:
                continue
            release = planned.release
            if isinstance(release, ServiceRelease):
                kind, ids = SubjectKind.APPLICATION, release.applications
            else:
                kind, ids = SubjectKind.CONNECTION, release.connections
            if fresh[kind].keys().isdisjoint(ids):
                continue
            kept = [claim for claim in planned.claims if id(claim) not in gone]
            added = [claim for id in ids for claim in fresh[kind].get(id, ())]
            needing = [claim for claim in added if release_causes.needs(claim, release)]
            if needing or len(kept) < len(planned.claims):
                yield key, replace(planned, claims=release_causes.by_booking([*kept, *needing]))

    def _plan(self, key: ReleaseKey) -> Planned | None:
        if (release := plan(self.state, key)) is None:
            return None
        target = rollouts.target_of(release, self.config.repo_settings)
        return Planned(release, target, release_causes.claims_behind(self.active.ledger, release))

    @cached_property
    def planned(self) -> dict[ReleaseKey, Planned | None]:
        # None if the release is denied, if all claims that need it are suspended, or if the client
        # of a connection carries no topic
        return {key: self._plan(key) for key in release_keys.all_keys(self.state)}

    @cached_property
    def _sorted(self) -> list[Planned]:
        running = filter(None, self.planned.values())
        return sorted(running, key=lambda each: (each.target.domain.cluster, each.target.name))

    @cached_property
    def targets(self) -> list[tuple[Release, Target]]:
        return [(planned.release, planned.target) for planned in self._sorted]

    @cached_property
    def denied(self) -> list[tuple[Release, Override]]:
        keys = (key for key, planned in self.planned.items() if planned is None)
        return [denied for key in keys if (denied := denied_release(self.state, key))]

    @cached_property
    def releases(self) -> dict[str, Release]:
        return {release.name: release for release, _ in self.targets}

    def override_entries(self, now: datetime) -> list[Entry]:
        # only the first call computes the report, so its `now` decides which overrides have expired
        if self._entries is None:
            self._entries = override_report(self.state, now)
        return self._entries

    @cached_property
    def claims_of_releases(self) -> dict[str, list[Claim]]:
        return {planned.target.name: planned.claims for planned in self._sorted}

    @cached_property
    def releases_of_demands(self) -> dict[str, list[str]]:
        releases: dict[str, list[str]] = {}
        for name, claims in self.claims_of_releases.items():
            for demand in dict.fromkeys(claim.demand for claim in claims):
                releases.setdefault(demand, []).append(name)
        return releases

    @cached_property
    def claims_of_demands(self) -> dict[str, list[Claim]]:
        claims_of: dict[str, list[Claim]] = {}
        for claim in self.state.ledger:
            claims_of.setdefault(claim.demand, []).append(claim)
        for claims in claims_of.values():
            if len(claims) > 1:
                claims.sort(key=lambda claim: str(claim.subject))
        return claims_of


@dataclass(frozen=True, slots=True)
class Situation:
    # for an earlier commit, all that the clusters report is empty
    commit_state: CommitState
    now: datetime
    is_newest: bool = True
    statuses: Mapping[str, ReleaseStatus] = field(default_factory=dict)
    watched: frozenset[str] = frozenset()  # clusters
    proposals: tuple[PendingProposal, ...] = ()
    unread: str = ""  # why a newer state cannot be read or shown
    push_denied: str = ""  # why the node that shows the page cannot publish demands
    old_bootstraps: tuple[OldBootstrap, ...] = ()
    orphans: tuple[Orphan, ...] = ()

    def status(self, release: str) -> ReleaseStatus:
        return self.statuses.get(release, _UNKNOWN)

    @property
    def unwatched(self) -> list[str]:
        used = {target.domain.cluster for _, target in self.commit_state.targets}
        return sorted(used - self.watched)


@dataclass(frozen=True, slots=True)
class HealthChange:
    time: datetime
    release: str
    before: str  # a word of `WORDS`, as `after` is
    after: str
    reason: str = ""
    # For a release that became healthy: how long the page saw that it was not.
    lasted_s: float | None = None


@dataclass(frozen=True, slots=True)
class Commit:
    entry: LogEntry
    roots: tuple[str, ...]  # the top-level files and folders that it changed
