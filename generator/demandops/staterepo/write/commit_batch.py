"""The commits of one batch, made on top of a snapshot and published together.

Each demand is one commit with its ledger and rendered files. :class:`CommitBatch` holds the commits
until they are published. If the remote has moved, the batch is dropped and its demands are
evaluated again on the new tip.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from types import MappingProxyType
from typing import Literal

import pygit2
from pygit2 import Oid, Signature

from demandops.config.config import Config
from demandops.config.override import Override
from demandops.decision import Decision, State, changeset_of_edit, rendered_files
from demandops.demand.claim import ClaimKey
from demandops.errors import Fault, InvalidInput, StateRepoError
from demandops.ledger import claim_file
from demandops.ledger.ledger import Ledger
from demandops.plan.overrides import kept_claims
from demandops.plan.overrides.lifecycle import (
    LedgerUpdate,
    changed_claim_files,
    changed_override_files,
    end_override,
    update_ledger,
)
from demandops.render.changes.changeset import Change, Changeset, ReleaseChange
from demandops.settings import GENERATED_ROOTS
from demandops.staterepo.git import signing
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.repository import StateRepository
from demandops.staterepo.history import authorship, commit_log, commit_message
from demandops.staterepo.load import (
    in_force_trailers,
    last_valid_config,
    problem_report,
    quarantine,
)
from demandops.staterepo.load import snapshot as snapshots
from demandops.staterepo.load.snapshot import Advance, Progress, Snapshot
from demandops.subject import Subject

_ATTEMPTS = 5
_PAUSE_S = 0.02


class CommitBatch:
    """Commits on top of one published tip, in the order of the demands."""

    def __init__(self, repository: StateRepository, start: Snapshot) -> None:
        self._repository = repository
        self._objects = repository.objects
        self._tree = trees.commit_of(self._objects, start.commit).tree
        self._settled: list[tuple[str, str]] = []
        self.start = start
        self.head = start

    def read(self, path: str) -> str | None:
        """Return a file's text at the newest commit of the batch, or None."""
        return trees.read_text(self._tree, path)

    def commit(
        self,
        decision: Decision,
        operation: str,
        received: datetime,
        now: datetime,
        proposal: str = "",
    ) -> str:
        """Commit one demand and return the commit's id.

        Args:
            proposal: the branch that it awaits approval on; empty if it needs no approval.
        """
        more = [*self._settled, *in_force_trailers.trailers_of(self.head)]
        if proposal:
            more.append((commit_message.PROPOSAL, proposal))
        text = commit_message.of_decision(decision, operation, received, more)
        self._settled = []
        made = self._write(decision.files, text, commit_message.author(decision, received), now)
        keys = [change.key for change in decision.changes.claims]
        self.head = self.head.with_commit(made, decision.state, keys)
        return str(made)

    def commit_files(
        self,
        files: Mapping[str, str | None],
        state: State,
        text: str,
        author: Signature,
        now: datetime,
        keys: Iterable[ClaimKey] = (),
    ) -> str:
        """Commit files and return the commit's id.

        ``state`` is the state after the commit, ``keys`` are the claims that it changes.
        """
        made = self._write(files, text, author, now)
        self.head = self.head.with_commit(made, state, keys)
        return str(made)

    def note_settled(self, operation: str, outcome: Literal["Unchanged", "Refused"]) -> None:
        """Have the next commit, if any, name a demand that changed nothing.

        If the process dies before it answers, a restart must not evaluate that demand again after
        a later release.
        """
        self._settled.append((f"{outcome}-Operation-Id", operation))

    def follow(self, advance: Advance, before: Snapshot, now: datetime) -> None:
        """Render what people changed and commit the files that differ, if any.

        What cannot be planned or rendered (a claim's node was removed from the inventory) stays
        as it was and is listed in the head's problems.
        """
        snapshot, good, faults = self._quarantine(advance.snapshot, before, advance.subjects)
        state, problems = snapshot.state, [*snapshot.problems, *faults]
        change = Changeset({}, ())
        keys: tuple[ClaimKey, ...] = ()
        whole = advance.config_changed
        if whole:
            try:
                state, change, keys = self._render_for_new_config(state, before, good, now)
            except InvalidInput as error:
                problems += error.faults
                config = before.state.config.with_ended_overrides(state.config.ended_overrides)
                state = replace(before.state, ledger=state.ledger, config=config)
                snapshot, good, faults = self._quarantine(
                    replace(snapshot, state=state), before, good
                )
                state, whole = snapshot.state, False
                snapshot = replace(snapshot, other_config_source=before.config_source)
                problems += faults
        if not whole:
            state, change, keys = self._render_subjects(state, before, good, problems, now)
        state, started = _start_leases(state, now)
        change = replace(change, files={**change.files, **started})
        last_valid_commit = before.last_valid_commit if problems else snapshot.commit
        self.head = replace(
            snapshot, state=state, problems=tuple(problems), last_valid_commit=last_valid_commit
        )
        report = self._report(problems, before)
        files = {**change.files, **report}
        if files:
            overrides = [
                *changed_override_files(before.state.config, state.config),
                *change.overrides,
            ]
            overrides += commit_message.keep_override_paths(keys)
            causes = authorship.person_commits_since(
                self._objects, before.last_valid_commit or before.commit, snapshot.commit
            )
            text = commit_message.of_follow(
                change.releases,
                str(snapshot.commit),
                str(before.commit),
                problems,
                [
                    *commit_message.override_trailers(overrides),
                    *authorship.caused_by_trailers(causes),
                    *in_force_trailers.trailers_of(self.head),
                ],
                reports=bool(report),
            )
            made = self._write(files, text, authorship.follow_author(causes, now), now)
            self.head = self.head.with_commit(made, state, keys)

    def _quarantine(
        self, snapshot: Snapshot, before: Snapshot, subjects: Iterable[Subject]
    ) -> tuple[Snapshot, list[Subject], list[Fault]]:
        return quarantine.quarantine_invalid(self._objects, snapshot, before, subjects, self.read)

    def _report(self, problems: Iterable[Fault], before: Snapshot) -> dict[str, str | None]:
        """Return the problem report, if it changed."""
        current = self.read(problem_report.PATH)
        origin = authorship.FaultOrigins(
            self._objects, before.last_valid_commit or before.commit, self.start.commit
        )
        wanted = problem_report.write(
            problem_report.with_origins(problems, problem_report.read(current), origin)
        )
        return {} if wanted == current else {problem_report.PATH: wanted}

    def _render_for_new_config(
        self, state: State, before: Snapshot, subjects: Iterable[Subject], now: datetime
    ) -> tuple[State, Changeset, tuple[ClaimKey, ...]]:
        """Render everything for a changed configuration."""
        marked = last_valid_config.end_markers_at(self._tree)
        applied = update_ledger(
            _ledger_and_config(before.state), _ledger_and_config(state), subjects, marked, now
        )
        state = _with_ledger_and_config(state, applied)
        return state, self.render_all(state, applied.files), applied.keys

    def end_override(self, override: Override, now: datetime) -> None:
        """Commit the end of an expired override, and what it changes.

        Raises:
            Refused, InvalidInput: the state without the override cannot be planned or rendered.
        """
        state = self.head.state
        applied = end_override(_ledger_and_config(state), override, now)
        state = _with_ledger_and_config(state, applied)
        change = self.render_all(state, applied.files)
        more = in_force_trailers.trailers_of(self.head)
        text = commit_message.of_override_end(override, change.releases, applied.keys, more)
        made = self._write(change.files, text, commit_message.generator_signature(now), now)
        self.head = self.head.with_commit(made, state, applied.keys)

    def _render_subjects(
        self,
        state: State,
        before: Snapshot,
        subjects: Iterable[Subject],
        problems: list[Fault],
        now: datetime,
    ) -> tuple[State, Changeset, tuple[ClaimKey, ...]]:
        """Plan and render the subjects that people changed; one that fails stays as it was.

        Adds the faults of those that fail to ``problems``.
        """
        good, keys = list[Subject](), list[ClaimKey]()
        old = before.state.ledger
        files: dict[str, str | None] = {}
        for subject in subjects:
            ledger, changed = kept_claims.update_kept_claims(
                old, state.ledger, [subject], state.config, now
            )
            tried = replace(state, ledger=ledger)
            try:
                changeset_of_edit(tried, old, [subject], self.read)
            except InvalidInput as error:
                problems += error.faults
                state = replace(state, ledger=state.ledger.with_claims_from(subject, old))
                continue
            files |= changed_claim_files(state.ledger, ledger, changed)
            state = tried
            good.append(subject)
            keys += changed
        change = changeset_of_edit(state, old, good, self.read)
        return state, replace(change, files={**files, **change.files}), tuple(keys)

    def render_all(
        self, state: State, more: Mapping[str, str | None] = MappingProxyType({})
    ) -> Changeset:
        """Return all generated files that differ from the current ones, and the files of ``more``.

        Raises:
            Refused, InvalidInput: a release cannot be planned or rendered.
        """
        generated = trees.texts(self._tree, GENERATED_ROOTS)
        files: dict[str, str | None] = dict(rendered_files(state, generated))
        changes = []
        current = {path for path in generated if path.endswith(".yaml")}
        for path in current - set(files):
            files[path] = None
        for path in sorted(files):
            old = self.read(path)
            if old == files[path]:
                del files[path]
                continue
            kind: Change = "stop" if files[path] is None else "start" if old is None else "change"
            name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
            changes.append(ReleaseChange(name, kind, path, ()))
        return Changeset({**more, **files}, tuple(changes))

    def _write(
        self, files: Mapping[str, str | None], text: str, author: Signature, now: datetime
    ) -> Oid:
        committer = commit_message.generator_signature(now)
        for attempt in range(1, _ATTEMPTS + 1):
            try:
                tree = trees.write(self._objects, self._tree, files)
                made = signing.create_commit(
                    self._objects,
                    self._repository.signer,
                    (author, committer),
                    text,
                    tree,
                    [self.head.commit],
                )
                self._tree = trees.commit_of(self._objects, made).tree
                break
            except signing.SigningFailed:
                raise
            except (OSError, pygit2.GitError, KeyError, StateRepoError):
                # a concurrent `git gc` may remove the folder of a new loose object, or pack an
                # object while it is read
                if attempt == _ATTEMPTS:
                    raise
                time.sleep(_PAUSE_S * attempt)
        return made

    def publish(self) -> bool:
        """Publish the commits; return false if the state repo has moved.

        Raises:
            RemoteAway, PushDenied: they could not be published for another reason.
        """
        if self.head.commit == self.start.commit:
            return True
        return self._repository.publish(self.start.commit, self.head.commit)


def _start_leases(state: State, now: datetime) -> tuple[State, dict[str, str]]:
    """Start the leases of claims that a person approved; return state and changed files.

    They start at approval because a lease could otherwise end before the demand is approved.
    """
    ledger, files = state.ledger, {}
    for claim in ledger.unstarted_claims():
        assert claim.lease is not None  # noqa: S101 - unstarted claims have a lease
        started = replace(claim, lease=claim.lease.restarted(now))
        ledger = ledger.replace(claim.key, started)
        files[claim_file.path_of(claim.key)] = claim_file.text_of(started)
    return replace(state, ledger=ledger), files


def _ledger_and_config(state: State) -> tuple[Ledger, Config]:
    return state.ledger, state.config


def _with_ledger_and_config(state: State, applied: LedgerUpdate) -> State:
    return replace(state, ledger=applied.ledger, config=applied.config)


def first_snapshot(repository: StateRepository, progress: Progress) -> Snapshot:
    """Return the snapshot of the generator's last commit.

    :func:`demandops.staterepo.load.snapshot.advance` then applies what people changed since.

    Raises:
        InvalidInput: that commit never had a valid configuration.
        StateRepoError: it is not a state repo.
    """
    tip = repository.tip()
    last_valid_config.refuse_other_render_version(trees.commit_of(repository.objects, tip).tree)
    base = commit_log.last_generator_commit(repository.objects, tip)
    base = base or tip
    made = trees.commit_of(repository.objects, base)
    record = commit_log.entry_of(made)
    if record.first("In-Force"):
        return in_force_trailers.snapshot_at(repository.objects, made, record)
    return snapshots.load_last_valid(repository.objects, base, progress)
