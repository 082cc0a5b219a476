"""The writer: a line of commits on top of a snapshot, published together or laid anew.

Each demand is one commit with its ledger and rendered files. :class:`Line` holds what is committed
here and not yet published; when the remote has moved it is dropped and the demands are judged
again on the new tip.
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
from demandops.demand.claim import ClaimKey, Subject
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
from demandops.staterepo.load import effective_config, last_valid_config, problem_report, quarantine
from demandops.staterepo.load import snapshot as snapshots
from demandops.staterepo.load.snapshot import Advance, Progress, Snapshot

_ATTEMPTS = 5
_PAUSE_S = 0.02


class CommitLine:
    """Commits made on top of one published tip, in the order of the demands."""

    def __init__(self, repository: StateRepository, start: Snapshot) -> None:
        self._repository = repository
        self._objects = repository.objects
        self._tree = trees.commit_of(self._objects, start.commit).tree
        self._settled: list[tuple[str, str]] = []
        self.start = start
        self.head = start

    def read(self, path: str) -> str | None:
        """Return a file as it is at the head of the line."""
        return trees.read_text(self._tree, path)

    def commit(
        self,
        decision: Decision,
        operation: str,
        received: datetime,
        now: datetime,
        proposal: str = "",
    ) -> str:
        """Commit one demand on top of the line and return the commit's id.

        Args:
            proposal: the branch that it awaits approval on; nothing where it needs none.
        """
        more = [*self._settled, *effective_config.trailers(self.head)]
        if proposal:
            more.append((commit_message.PROPOSAL, proposal))
        text = commit_message.of_decision(decision, operation, received, more)
        self._settled = []
        made = self._write(decision.files, text, commit_message.author(decision, received), now)
        keys = [change.key for change in decision.changes.claims]
        self.head = self.head.after(made, decision.state, keys)
        return str(made)

    def record(
        self,
        files: Mapping[str, str | None],
        state: State,
        text: str,
        author: Signature,
        now: datetime,
        keys: Iterable[ClaimKey] = (),
    ) -> str:
        """Commit what a person had done by a command.

        ``state`` is what the files give then, ``keys`` the claims that changed with them.
        """
        made = self._write(files, text, author, now)
        self.head = self.head.after(made, state, keys)
        return str(made)

    def note(self, operation: str, outcome: Literal["Unchanged", "Refused"]) -> None:
        """Have the next commit name a demand that changed nothing, if there is a next one.

        Should the process die before it answers, that demand must not be judged again behind a
        release that came after it.
        """
        self._settled.append((f"{outcome}-Operation-Id", operation))

    def follow(self, advance: Advance, before: Snapshot, now: datetime) -> None:
        """Commit what people's changes ask of the rendered files, if anything.

        What cannot be planned or rendered (a node that is in use is gone from the inventory) is
        left as it was before, and told in the head's problems.
        """
        snapshot, good, found = self._held_back(advance.snapshot, before, advance.subjects)
        state, problems = snapshot.state, [*snapshot.problems, *found]
        change = Changeset({}, ())
        keys: tuple[ClaimKey, ...] = ()
        whole = advance.config_changed
        if whole:
            try:
                state, change, keys = self._taken_in(state, before, good, now)
            except InvalidInput as error:
                problems += error.faults
                config = before.state.config.with_ended_overrides(state.config.ended_overrides)
                state = replace(before.state, ledger=state.ledger, config=config)
                snapshot, good, found = self._held_back(
                    replace(snapshot, state=state), before, good
                )
                state, whole = snapshot.state, False
                snapshot = replace(snapshot, source=before.configuration)
                problems += found
        if not whole:
            state, change, keys = self._carried_out(state, before, good, (problems, now))
        state, begun = _with_leases_begun(state, now)
        change = replace(change, files={**change.files, **begun})
        sound = before.sound if problems else snapshot.commit
        self.head = replace(snapshot, state=state, problems=tuple(problems), sound=sound)
        files = {**change.files, **self._report(problems, before)}
        if files:
            overrides = [
                *changed_override_files(before.state.config, state.config),
                *change.overrides,
            ]
            overrides += commit_message.keeping(keys)
            causes = authorship.since(self._objects, before.sound or before.commit, snapshot.commit)
            text = commit_message.of_follow(
                change.releases,
                str(snapshot.commit),
                str(before.commit),
                problems,
                [
                    *commit_message.of_overrides(overrides),
                    *authorship.trailers(causes),
                    *effective_config.trailers(self.head),
                ],
            )
            made = self._write(files, text, authorship.author(causes, now), now)
            self.head = self.head.after(made, state, keys)

    def _held_back(
        self, snapshot: Snapshot, before: Snapshot, subjects: Iterable[Subject]
    ) -> tuple[Snapshot, list[Subject], list[Fault]]:
        return quarantine.held_back(self._objects, snapshot, before, subjects, self.read)

    def _report(self, problems: Iterable[Fault], before: Snapshot) -> dict[str, str | None]:
        """Return the report on what is not valid, where it is not what stands there already."""
        standing = self.read(problem_report.PATH)
        origin = authorship.Origins(self._objects, before.sound or before.commit, self.start.commit)
        wanted = problem_report.write(
            problem_report.reported(problems, problem_report.read(standing), origin)
        )
        return {} if wanted == standing else {problem_report.PATH: wanted}

    def _taken_in(
        self, state: State, before: Snapshot, subjects: Iterable[Subject], now: datetime
    ) -> tuple[State, Changeset, tuple[ClaimKey, ...]]:
        """Render everything for a configuration that changed."""
        marked = last_valid_config.markers_at(self._tree)
        taken = update_ledger(_books(before.state), _books(state), subjects, marked, now)
        state = _with(state, taken)
        return state, self.everything(state, taken.files), taken.keys

    def end(self, override: Override, now: datetime) -> None:
        """Commit that an override's time is over, and what follows.

        Raises:
            Refused, InvalidInput: where what is left cannot be planned or rendered.
        """
        state = self.head.state
        taken = end_override(_books(state), override, now)
        state = _with(state, taken)
        change = self.everything(state, taken.files)
        more = effective_config.trailers(self.head)
        text = commit_message.of_ended(override, change.releases, taken.keys, more)
        made = self._write(change.files, text, commit_message.generator_signature(now), now)
        self.head = self.head.after(made, state, taken.keys)

    def _carried_out(
        self,
        state: State,
        before: Snapshot,
        subjects: Iterable[Subject],
        noted: tuple[list[Fault], datetime],
    ) -> tuple[State, Changeset, tuple[ClaimKey, ...]]:
        """Plan and render the subjects that people changed; one that fails stays as it was."""
        problems, now = noted
        good, keys = list[Subject](), list[ClaimKey]()
        books = before.state.ledger
        files: dict[str, str | None] = {}
        for subject in subjects:
            ledger, own = kept_claims.update_kept_claims(
                books, state.ledger, [subject], state.config, now
            )
            tried = replace(state, ledger=ledger)
            try:
                changeset_of_edit(tried, books, [subject], self.read)
            except InvalidInput as error:
                problems += error.faults
                state = replace(state, ledger=state.ledger.with_claims_from(subject, books))
                continue
            files |= changed_claim_files(state.ledger, ledger, own)
            state = tried
            good.append(subject)
            keys += own
        change = changeset_of_edit(state, books, good, self.read)
        return state, replace(change, files={**files, **change.files}), tuple(keys)

    def everything(
        self, state: State, more: Mapping[str, str | None] = MappingProxyType({})
    ) -> Changeset:
        """Return all generated files that differ from what stands, with ``more`` of the ledger.

        Raises:
            Refused, InvalidInput: where a release cannot be planned or rendered.
        """
        generated = trees.texts(self._tree, GENERATED_ROOTS)
        files: dict[str, str | None] = dict(rendered_files(state, generated))
        changes = []
        standing = {path for path in generated if path.endswith(".yaml")}
        for path in standing - set(files):
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
                # git's housekeeping removes a folder of loose objects just as one is put there,
                # or moves one into a pack just as it is looked for
                if attempt == _ATTEMPTS:
                    raise
                time.sleep(_PAUSE_S * attempt)
        return made

    def publish(self) -> bool:
        """Publish the line; false where the state repo has moved meanwhile.

        Raises:
            RemoteAway, PushDenied: where it could not be published for another reason.
        """
        if self.head.commit == self.start.commit:
            return True
        return self._repository.publish(self.start.commit, self.head.commit)


def _with_leases_begun(state: State, now: datetime) -> tuple[State, dict[str, str]]:
    """Start the leases of claims that a person approved; return their files as well.

    A lease that counted from the demand could be over before anybody has approved it.
    """
    ledger, files = state.ledger, {}
    for claim in ledger.unstarted_claims():
        assert claim.lease is not None  # noqa: S101 - that is what was looked for
        begun = replace(claim, lease=claim.lease.restarted(now))
        ledger = ledger.replace(claim.key, begun)
        files[claim_file.path_of(claim.key)] = claim_file.text_of(begun)
    return replace(state, ledger=ledger), files


def _books(state: State) -> tuple[Ledger, Config]:
    return state.ledger, state.config


def _with(state: State, taken: LedgerUpdate) -> State:
    return replace(state, ledger=taken.ledger, config=taken.config)


def first_snapshot(repository: StateRepository, progress: Progress) -> Snapshot:
    """Load the books at the generator's last commit.

    What people changed since then is taken in by :func:`demandops.staterepo.load.snapshot.advance`,
    as it would have been had the generator been running.

    Raises:
        InvalidInput: with every fault, where that commit is not valid.
        StateRepoError: where this is no state repo.
    """
    tip = repository.tip()
    last_valid_config.refuse_other_rendering(trees.commit_of(repository.objects, tip).tree)
    base = commit_log.last_generated(repository.objects, tip)
    base = base or tip
    made = trees.commit_of(repository.objects, base)
    told = commit_log.entry_of(made)
    if told.one("In-Force"):
        return effective_config.at(repository.objects, made, told)
    return snapshots.load_last_valid(repository.objects, base, progress)
