"""The commits of one batch, made on top of a snapshot and published together.

Each demand that changes the ledger becomes one commit with the changed ledger and rendered files.
:class:`CommitBatch` holds the commits until they are published. If another writer publishes first,
the batch is dropped and its demands are evaluated again on the new tip.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import islice

import pygit2
from pygit2 import Signature

from demandops.base.errors import StateRepoError
from demandops.base.quoting import one_line
from demandops.base.runtime import log
from demandops.decide import edits
from demandops.decide.booking import Drain
from demandops.decide.decision import Decision, decide
from demandops.decide.discovery import Discovered
from demandops.decide.state import Changeset, State
from demandops.model.config.config import CONFIG_ROOTS, NODES_FILE
from demandops.model.config.discovered import is_discovered
from demandops.model.config.load import load as load_config
from demandops.model.config.override import Override
from demandops.render import gitops
from demandops.repo.git import tree as trees
from demandops.repo.git.repository import StateRepository
from demandops.repo.git.signing import SigningFailed
from demandops.repo.history import commit_log, commit_message
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.snapshot import Followed, Snapshot

_ATTEMPTS = 5
_PAUSE_S = 0.02


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
        # whether that commit is the first to say that a configuration is not in effect
        self.tells = False

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
        more = [*self._settled, *self.head.trailers, *more]
        text = commit_message.of_decision(decision, operation, received, more)
        self._settled = []
        self.awaited = self.awaited or decision.awaited
        author = commit_message.author(decision, received)
        return self.commit_files(decision.files, decision.state, text, now, author)

    def commit_files(
        self,
        files: Mapping[str, str | None],
        state: State,
        text: str,
        now: datetime,
        author: Signature | None = None,  # if it is not the generator
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
                    (author or committer, committer),
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
        held = self.head.faults
        self.head = replace(
            self.head,
            commit=commit,
            state=state,
            configuration=self.head.configuration if held else commit,
            written=commit,
            told=self.head.refused if held else None,
            put_back={},
            claim_faults=(),
        )
        return str(commit)

    def commit_without_files(
        self, paragraphs: list[list[str]], trailers: commit_message.Trailers, now: datetime
    ) -> None:
        text = commit_message.of_generator(paragraphs, [*trailers, *self.head.trailers])
        self.commit_files({}, self.head.state, text, now)

    def record_in_next_commit(self, operation: str, outcome: commit_log.Settled) -> None:
        # The process may die before it answers the demand. After a restart, it must not evaluate
        # the demand again, because later demands could change the outcome.
        self._settled.append((commit_log.settled_trailer(outcome), operation))

    def follow(self, followed: Followed, now: datetime) -> None:
        """Carry out people's commits: commit what a generator must write because of them, if any.

        The commit also says which configuration is in effect, if that has changed.
        """
        self.head, before, change = followed.snapshot, followed.before, followed.change
        if not change.files and self.head.is_told:
            return
        overrides = edits.changed_override_files(before.state, self.head.state)
        of_overrides = commit_message.override_trailers(
            [*overrides, *change.overrides], followed.keys
        )
        # also of those whose commits were not in effect until now
        causes = commit_log.person_commits_since(
            self._objects, before.configuration, self.start.commit
        )
        self.tells = bool(self.head.faults) and not self.head.is_told
        told = self.head if self.tells else replace(self.head, faults=())
        text = commit_message.of_follow(
            change.releases,
            str(self.start.commit),
            str(before.commit),
            str(told.configuration) if told.faults else "",
            snapshots.problems_of(self._objects, told),
            snapshots.how_to_mend(self._objects, told),
            [
                *of_overrides,
                *commit_message.demand_trailers(followed.keys),
                *commit_log.caused_by_trailers(causes),
                *self.head.trailers,
            ],
        )
        author = commit_log.follow_author(causes, now)
        self.commit_files(change.files, self.head.state, text, now, author)
        title = text.partition("\n")[0]
        self.followed = one_line(", ".join([title, *(path for _, path in of_overrides)]))

    def texts(self, root: str) -> dict[str, str]:
        return trees.texts(self._tree, (root,))

    def take_over(self, found: Sequence[Discovered], now: datetime) -> None:
        """Commit what clusters say of their nodes; raise InvalidInput if that is not valid here."""
        before, files = self.head.state, {each.path: each.text for each in found}
        texts: dict[str, str | None] = {**trees.texts(self._tree, CONFIG_ROOTS), **files}
        config = load_config({path: text for path, text in texts.items() if text is not None})
        ids = (id for each in found for id in each.new_ids)
        if any(before.ledger.claims_needing(id) for id in ids):  # they were of a pattern until now
            state = State(config, before.ledger, before.evaluate)
            change = snapshots.render_all(self._tree, state, files)
        else:
            state, change = before.with_nodes(config), Changeset(files, ())
            wanted = gitops.base_files(config)
            for path in sorted({*gitops.base_files(before.config), *wanted}):
                if self.read(path) != wanted.get(path):
                    files[path] = wanted.get(path)
        text = commit_message.of_discovery(found, change.releases)
        self.commit_files(change.files, state, text, now)
        log.info("%s", text.partition("\n")[0])

    def end_override(self, override: Override, now: datetime) -> None:
        # InvalidInput is raised if the state without the override cannot be planned or rendered
        state = self.head.state
        applied = edits.update_ledger(state, state, (), {}, now, ending=[override])
        state = replace(state, ledger=applied.ledger)
        change = snapshots.render_all(self._tree, state, applied.files)
        more = self.head.trailers
        text = commit_message.of_override_end(override, change.releases, applied.keys, more)
        self.commit_files(change.files, state, text, now)

    def drain(self, node: str, after: str, operation: str, now: datetime) -> Decision:
        # it begins with the application that follows ``after``; if none can move, nothing changes
        decision = decide(self.head.state, Drain(id=node, after=after), now, self.read)
        if decision.files:
            # the author is the person who last changed the node's file, and so drained the node
            config = decision.state.config
            file = config.file_of(NODES_FILE, config.host_of(node))
            changes = commit_log.changes_to(self._objects, self.start.configuration, file)
            by_people = (entry.commit for entry, _, _ in changes if not entry.by_generator)
            most = 0 if is_discovered(file) else 1  # it was cordoned in its cluster
            causes = [trees.commit_of(self._objects, each) for each in islice(by_people, most)]
            caused_by = commit_log.caused_by_trailers(causes)
            more = [*caused_by, *self.head.trailers]
            text = commit_message.of_decision(decision, operation, now, more)
            author = commit_log.follow_author(causes, now)
            self.commit_files(decision.files, decision.state, text, now, author)
        return decision

    def publish(self) -> bool:
        if self.is_empty:
            return True
        return self._repository.publish(self.start.commit, self.head.commit)
