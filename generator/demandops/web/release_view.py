"""The views of one demand and of one release."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime

from demandops.base import strict_yaml
from demandops.base.errors import DemandOpsError, InvalidInput, StateRepoError
from demandops.base.quoting import quoted
from demandops.base.settings import API_VERSION
from demandops.cluster.release_status import ReleaseStatus
from demandops.decide.decision import Decision, decide
from demandops.model.config.override import Override
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.release import Release, ServiceRelease
from demandops.render.gitops import path_of
from demandops.repo.history.commit_log import LogEntry, PathHistory
from demandops.repo.reader import Reader
from demandops.views import release_causes
from demandops.views.release_causes import how_to_release, is_released_by_demand_id
from demandops.web.situation import WORDS, CommitState, Situation, since_of, word_of

# ---- the view of one demand ----


@dataclass(frozen=True, slots=True)
class ExplainedDemand:
    id: str
    claims: Sequence[Claim]
    requesters: tuple[str, ...]
    releases: Sequence[str]  # the names of those that it needs
    how: str  # to release it
    file: str  # for `demandops request`, if the demand can be released by its id
    released: Decision | None  # what would change if it were released
    refused: str  # why the generator would refuse that


def explained_demand(now: Situation, reader: Reader, id: str) -> ExplainedDemand:
    if not (claims := now.commit_state.claims_of_demands.get(id)):
        waiting = now.commit_state.state.ledger.waiting.values()
        is_waiting = any(demand.demand == id for demand in waiting)
        why = ", because it waits for room on a node" if is_waiting else ""
        raise StateRepoError(f"demand {quoted(id)} holds nothing{why}")
    requesters = requesters_of(claims)
    goal = {
        "apiVersion": API_VERSION,
        "kind": "Demand",
        "operation": "release",
        "demand": id,
        "requesters": list(requesters),
    }
    how = how_to_release(claims[0])
    file = strict_yaml.dump(goal) if is_released_by_demand_id(claims[0]) else ""
    released, refused = None, ""
    try:
        read = reader.file_reader(now.commit_state.commit)
        released = decide(now.commit_state.state, goal, now.now, read)
    except InvalidInput as error:
        refused = str(error)
    releases = now.commit_state.releases_of_demands.get(id, [])
    return ExplainedDemand(id, claims, requesters, releases, how, file, released, refused)


# ---- the view of one release ----


@dataclass(frozen=True, slots=True)
class DiffLine:
    sign: str  # `+`, `-`, `@` at the head of a section, or empty
    text: str


@dataclass(frozen=True, slots=True)
class Explained:
    name: str
    path: str
    release: Release | None  # None if it does not run
    denied_by: Override | None
    status: ReleaseStatus
    claims: tuple[Claim, ...]
    files: tuple[tuple[str, str, str], ...]
    overrides: tuple[tuple[Override, tuple[str, ...]], ...]
    text: str
    history: PathHistory
    last_change: LogEntry | None
    difference: tuple[DiffLine, ...]  # the newest change of the release's file
    # The other releases that the override stops which the page proposes for this one.
    stop_with_it: tuple[str, ...]

    @property
    def word(self) -> str:
        return word_of(self.status) if self.release else "stopped"

    @property
    def tone(self) -> str:
        return WORDS.get(self.word, "none")

    @property
    def since(self) -> datetime | None:
        return since_of(self.status)

    @property
    def requesters(self) -> list[str]:
        return sorted({who for claim in self.claims for who in claim.requesters})


def explained_release(now: Situation, reader: Reader, name: str) -> Explained:
    commit_state = now.commit_state
    release = commit_state.releases.get(name)
    denied = None if release else release_causes.denied_release_named(commit_state.state, name)
    planned = release or (denied[0] if denied else None)
    path = path_of(planned) if planned else None
    path = path or reader.release_path(name, commit_state.commit)
    if path is None:
        raise StateRepoError(
            f"up to commit {commit_state.commit[:10]}, there was no release {quoted(name)}"
        )
    history = reader.history(path, commit_state.commit, most=20)
    last = next(iter(history.newest), None) or history.started
    if history.stopped and not release:
        last = history.stopped
    difference: list[DiffLine] = []
    if last:
        after, before = reader.file_reader(last.commit)(path) or "", ""
        with suppress(DemandOpsError):  # the first commit has no parent to compare with
            before = reader.file_reader(f"{last.commit}~1")(path) or ""
        lines = difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=2)
        for line in list(lines)[2:]:  # without the two lines that name the files
            sign = line[:1].strip()
            difference.append(DiffLine(sign, line if sign == "@" else line[1:]))
    return Explained(
        name=name,
        path=path,
        release=release,
        denied_by=denied[1] if denied else None,
        status=now.status(name),
        claims=tuple(commit_state.claims_of_releases.get(name, ())),
        files=tuple(release_causes.shaping_files(release, commit_state.config)) if release else (),
        overrides=release.shaping.by if release else (),
        text=reader.file_reader(commit_state.commit)(path) or "",
        history=history,
        last_change=last,
        difference=tuple(difference),
        stop_with_it=tuple(_others_stopped(commit_state, release)) if release else (),
    )


def _others_stopped(commit_state: CommitState, release: Release) -> Iterable[str]:
    for name, other in commit_state.releases.items():
        if name == release.name:
            continue
        if isinstance(release, ServiceRelease):
            # it denies the service on its node, whatever the service runs for
            if isinstance(other, ServiceRelease) and (
                (other.key.service, other.node.id) == (release.key.service, release.node.id)
            ):
                yield name
        elif not isinstance(other, ServiceRelease) and (
            # it denies all connections that the client carries
            set(other.connections) <= set(release.connections)
        ):
            yield name
