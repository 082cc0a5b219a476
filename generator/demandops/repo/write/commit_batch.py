"""The commits of one batch, made on top of a snapshot and published together.

Each demand that changes the ledger becomes one commit with the changed ledger and rendered files.
:class:`CommitBatch` holds the commits until they are published. If another writer publishes first,
the batch is dropped and its demands are evaluated again on the new tip.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from itertools import islice
from types import MappingProxyType

import pygit2
from pygit2 import Signature

from demandops.base.errors import InvalidInput, StateRepoError
from demandops.base.quoting import one_line
from demandops.base.settings import GENERATED_ROOTS
from demandops.decide import edits
from demandops.decide.booking import Drain
from demandops.decide.changeset import Change, Changeset, ReleaseChange
from demandops.decide.decision import Decision, decide
from demandops.decide.state import State, rendered_files
from demandops.model.config.config import NODES_FILE
from demandops.model.config.override import Override
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import ClaimKey
from demandops.model.ledger.ledger import claim_changes
from demandops.repo.git import tree as trees
from demandops.repo.git.repository import StateRepository
from demandops.repo.git.signing import SigningFailed
from demandops.repo.history import commit_log, commit_message
from demandops.repo.load import last_valid_config, ledger_files
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.snapshot import Advance, Snapshot

_ATTEMPTS = 5
_PAUSE_S = 0.02
# The effect of people's changes: the snapshot, the changed files, and the keys of the claims that
# overrides may have changed.
_Followed = tuple[Snapshot, Changeset, tuple[ClaimKey, ...]]


class CommitBatch:
    """Commits on top of one published tip; :meth:`publish` publishes them together."""

    def __init__(self, repository: StateRepository, start: Snapshot) -> None:
        self._repository = repository
        self._objects = repository.objects
        repository.new.forget()
        self._tree = trees.commit_of(self._objects, start.commit).tree
        self._settled: list[tuple[str, str]] = []
        self.start = start
        self.head = start
        # whether a demand freed room on a node since the caller last set this to false
        self.awaited = False
        # the log line about the follow commit, which renders people's changes; empty if none
        self.followed = ""

    @property
    def is_empty(self) -> bool:
        return self.head.commit == self.start.commit

    def read(self, path: str) -> str | None:
        return trees.read_text(self._tree, path)

    def commit(
        self,
        decision: Decision,
        operation: str,
        received: datetime,
        now: datetime,
        more: commit_message.Trailers = (),
    ) -> str:
        more = [*self._settled, *snapshots.trailers_of(self.head), *more]
        text = commit_message.of_decision(decision, operation, received, more)
        self._settled = []
        self.awaited = self.awaited or decision.awaited
        author = commit_message.author(decision, received)
        return self.commit_files(decision.files, decision.state, text, author, now)

    def commit_files(
        self,
        files: Mapping[str, str | None],
        state: State,
        text: str,
        author: Signature,
        now: datetime,
    ) -> str:
        committer = commit_message.generator_signature(now)
        if signed_off_by := state.config.repo_settings.signed_off_by:
            text = commit_message.signed_off(text, signed_off_by)
        for attempt in range(1, _ATTEMPTS + 1):
            try:
                new = self._repository.new
                tree = new.add_tree(self._tree, files)
                commit = new.add_commit(
                    self._repository.signer,
                    (author, committer),
                    text,
                    tree,
                    [self.head.commit],
                )
                self._tree = trees.commit_of(self._objects, commit).tree
                break
            except SigningFailed:
                raise
            except (OSError, pygit2.GitError, KeyError, StateRepoError):
                # a concurrent `git gc` may move an object to another file while it is read
                if attempt == _ATTEMPTS:
                    raise
                self._repository.runtime.sleep(_PAUSE_S * attempt)
        valid = self.head.last_valid_commit if self.head.problems else commit
        self.head = replace(self.head, commit=commit, state=state, last_valid_commit=valid)
        return str(commit)

    def record_in_next_commit(self, operation: str, outcome: commit_log.Settled) -> None:
        # The process may die before it answers the demand. After a restart, it must not evaluate
        # the demand again, because later demands could change the outcome.
        self._settled.append((commit_log.settled_trailer(outcome), operation))

    def follow(self, advance: Advance, before: Snapshot, now: datetime) -> None:
        """Render people's changes, and commit the generated files that differ, if any.

        What cannot be planned or rendered stays in effect as it was, as a problem of ``head``.
        """
        self.head, change, keys = self._followed(advance, before, now)
        state, tip, problems = self.head.state, self.head.commit, self.head.problems
        files, reported = dict(change.files), self.read(last_valid_config.PATH)
        origin = commit_log.fault_origin(self._objects, before.last_valid_commit, self.start.commit)
        report = last_valid_config.write(
            last_valid_config.with_origins(problems, last_valid_config.read(reported), origin)
        )
        if report != reported:
            files[last_valid_config.PATH] = report
        if not files:
            return
        overrides = [
            *edits.changed_override_files(before.state, state),
            *change.overrides,
        ]
        of_overrides = commit_message.override_trailers(overrides, keys)
        causes = commit_log.person_commits_since(self._objects, before.last_valid_commit, tip)
        text = commit_message.of_follow(
            change.releases,
            str(tip),
            str(before.commit),
            problems,
            [
                *of_overrides,
                *commit_message.demand_trailers(keys),
                *commit_log.caused_by_trailers(causes),
                *snapshots.trailers_of(self.head),
            ],
            reports=report != reported,
        )
        author = commit_log.follow_author(causes, now)
        self.commit_files(files, state, text, author, now)
        title = text.partition("\n")[0]
        self.followed = one_line(", ".join([title, *(path for _, path in of_overrides)]))

    def _followed(self, advance: Advance, before: Snapshot, now: datetime) -> _Followed:
        judgement = snapshots.judge(self._objects, advance, before, self._tree)
        accepted, change = judgement.with_new_config(), None
        if advance.config_changed:
            try:
                marked = last_valid_config.end_markers_at(self._tree)
                state, subjects = accepted.snapshot.state, accepted.subjects
                applied = edits.update_ledger(before.state, state, subjects, marked, now)
                state = replace(state, ledger=applied.ledger)
                change = self.render_all(state, applied.files)
            except InvalidInput as error:
                accepted = judgement.with_old_config(error.faults)
        if change is None:
            # with the configuration as before, only the subjects that people changed are rendered
            state, old, subjects = accepted.snapshot.state, before.state.ledger, accepted.subjects
            applied = edits.update_claims(old, state, subjects, now)
            touched = claim_changes(state.ledger, applied.ledger, applied.keys)
            state = state.with_ledger(applied.ledger, touched)
            subjects = tuple(dict.fromkeys((*subjects, *(edit.key.subject for edit in touched))))
            change = edits.changeset_of_edit(state, old, subjects, self.read)
            change = replace(change, files={**applied.files, **change.files})
        # an approved claim's lease starts only now, because else it could end before the approval
        snapshot, ledger, files = accepted.snapshot, state.ledger, dict(change.files)
        for claim in ledger.unstarted_claims():
            assert claim.lease is not None  # noqa: S101 - unstarted claims have a lease
            path = claim_files.path_of(claim.key)
            earlier = ledger_files.lease_before_approval(self._objects, snapshot.commit, path)
            started = replace(claim, lease=claim.lease.started(now, earlier))
            ledger = ledger.replace(claim.key, started)
            files[path] = claim_files.text_of(started)
        # a lease does not affect a release, so the usage of nodes need not be counted again
        snapshot = replace(snapshot, state=state.with_ledger(ledger, ()))
        return snapshot, replace(change, files=files), tuple(applied.keys)

    def end_override(self, override: Override, now: datetime) -> None:
        # InvalidInput is raised if the state without the override cannot be planned or rendered
        applied = edits.end_override(self.head.state, override, now)
        state = replace(self.head.state, ledger=applied.ledger)
        change = self.render_all(state, applied.files)
        more = snapshots.trailers_of(self.head)
        text = commit_message.of_override_end(override, change.releases, applied.keys, more)
        self.commit_files(change.files, state, text, commit_message.generator_signature(now), now)

    def drain(self, node: str, after: str, operation: str, now: datetime) -> Decision:
        # it begins with the application that follows ``after``; if none can move, nothing changes
        decision = decide(self.head.state, Drain(id=node, after=after), now, self.read)
        if decision.files:
            # the author is the person who last changed the node's file, and so drained the node
            config = decision.state.config
            file = config.file_of(NODES_FILE, config.host_of(node))
            changes = commit_log.changes_to(self._objects, self.start.commit, file)
            by_people = (change.entry for change in changes if not change.entry.by_generator)
            causes = [trees.commit_of(self._objects, e.commit) for e in islice(by_people, 1)]
            caused_by = commit_log.caused_by_trailers(causes)
            more = [*caused_by, *snapshots.trailers_of(self.head)]
            text = commit_message.of_decision(decision, operation, now, more)
            author = commit_log.follow_author(causes, now)
            self.commit_files(decision.files, decision.state, text, author, now)
        return decision

    def render_all(
        self, state: State, more: Mapping[str, str | None] = MappingProxyType({})
    ) -> Changeset:
        generated = trees.texts(self._tree, GENERATED_ROOTS)
        files: dict[str, str | None] = dict(rendered_files(state, generated, keeps_late=True))
        changes = []
        are_files = {
            path: trees.is_file(child) for path, child in trees.entries(self._tree, GENERATED_ROOTS)
        }
        for path, is_file in are_files.items():
            if path not in files and not (is_file and trees.is_readme(path)):
                files[path] = None
        for path in sorted(files):
            old = generated.get(path)
            # a link is replaced by a file, even if its text is the right one
            if old == files[path] and are_files.get(path, True):
                del files[path]
                continue
            kind: Change = "stop" if files[path] is None else "start" if old is None else "change"
            name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
            changes.append(ReleaseChange(name, path, path, kind))
        return Changeset({**more, **files}, tuple(changes))

    def publish(self) -> bool:
        if self.is_empty:
            return True
        return self._repository.publish(self.start.commit, self.head.commit)
