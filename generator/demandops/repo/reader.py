"""Reads a state repo for the command line and the web page: commits, states and history."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

import pygit2
from pygit2 import Commit, Oid, Tree

from demandops.base import naming, settings
from demandops.base.errors import BeforeTheFirst, InvalidInput, StateRepoError
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.base.strict_yaml import with_lines
from demandops.decide.state import FileReader, rendered_files
from demandops.model.config.config import Config
from demandops.model.config.override import OVERRIDES_ROOT, override_selects
from demandops.render.gitops import CLUSTERS_ROOT
from demandops.repo import verification
from demandops.repo.git import repository as repositories
from demandops.repo.git import tree as trees
from demandops.repo.git.remote_repository import Slot, connect, is_url
from demandops.repo.git.repository import StateRepository, reading, using
from demandops.repo.history import commit_log
from demandops.repo.history.commit_log import LogEntry, PathHistory, Person
from demandops.repo.history.commit_message import PROPOSAL
from demandops.repo.load import ledger_files
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.ledger_files import valid_claim_at
from demandops.repo.load.snapshot import Progress, Snapshot
from demandops.repo.verification import Verdict


class Reader:
    """Reads a state repo at its newest commit, or a checkout at the commit that is checked out."""

    def __init__(self, repository: StateRepository, tip: Oid, slot: Slot | None = None) -> None:
        self.repository, self._tip, self._slot = repository, tip, slot
        self._merged: tuple[Oid | None, Mapping[str, Commit]] = (None, {})  # of main at a commit
        self.objects = repository.objects

    @classmethod
    def of(cls, address: str, *, only_read: bool = True) -> Reader:
        with ExitStack() as undo:
            with using(f"the data folder of {address}"):
                # The clone of a URL stays on the disk for later readers. It is in a folder of
                # readers, so that none takes over a generator's journal.
                is_cloned = is_url(address) or (not only_read and repositories.needs_push(address))
                slot = Slot(settings.data_home(address) / "reader") if is_cloned else None
            if slot is not None:
                undo.callback(slot.close)
            with using(address):
                repository = connect(address, slot.folder if slot else Path(), only_read=only_read)
                reader = cls(repository, repository.refresh(), slot)
            undo.pop_all()
            return reader

    def close(self) -> None:
        if self._slot is not None:
            self._slot.close()

    def refresh(self) -> str:
        try:
            self._tip = self.repository.refresh()
        except (pygit2.GitError, KeyError, OSError) as error:
            raise StateRepoError(f"{self.repository.address} cannot be read: {error}") from None
        return str(self._tip)

    def for_another_thread(self) -> Reader:
        # at the same commit, without a fetch
        other = Reader(self.repository, self._tip)
        try:
            other.objects = self.repository.reopened()
        except (pygit2.GitError, OSError) as error:
            raise StateRepoError(f"{self.repository.address} cannot be read: {error}") from None
        return other

    def commit(self, revision: str | None = None) -> str:
        if not revision:
            return str(self._tip)
        return str(commit_log.resolve(self.objects, self._tip, revision, REAL.now()).id)

    def snapshot(
        self, revision: str | None = None, progress: Progress = lambda done, total: None
    ) -> Snapshot:
        commit = self.commit(revision)
        try:
            return snapshots.state_at(self.objects, commit, progress)
        except InvalidInput as error:
            raise InvalidInput(with_lines(error.faults, self.file_reader(commit))) from None

    def snapshot_after(self, before: Snapshot) -> Snapshot:
        now = commit_log.time_of(trees.commit_of(self.objects, self._tip))
        return snapshots.follow(self.objects, before, self._tip, now).snapshot

    def not_rendered(self, snapshot: Snapshot) -> frozenset[str]:
        # only a person's commit may leave such files, and rendering everything takes time
        commit = trees.commit_of(self.objects, snapshot.commit)
        if commit_log.is_by_generator(self.objects, commit):
            return frozenset()
        try:
            return self._unlike_rendered(snapshot)
        except InvalidInput:
            return frozenset()

    def _unlike_rendered(self, snapshot: Snapshot) -> frozenset[str]:
        tree = trees.commit_of(self.objects, snapshot.commit).tree
        texts = trees.texts(tree, settings.GENERATED_ROOTS)
        current = {path: text for path, text in texts.items() if not trees.is_readme(path)}
        wanted = rendered_files(snapshot.state, current)
        return frozenset(
            path for path in {*current, *wanted} if current.get(path) != wanted.get(path)
        )

    def edited_files(self, before: str, after: Snapshot) -> list[str]:
        # Files that are as rendered from the claims are left out, whoever committed them: anybody
        # can commit under the generator's name.
        old, new = self._tree(before), self._tree(str(after.commit))
        changed = trees.differences(old, new, settings.GENERATED_ROOTS)
        as_rendered = set[str]()
        with suppress(InvalidInput):
            unlike = self._unlike_rendered(after)
            as_rendered = {path for path, _ in changed if not trees.is_readme(path)} - unlike
        claims = {
            path
            for path in ledger_files.changed_files(old, new)
            if (trees.entry(old, path) is None and valid_claim_at(new, path))
            or (trees.entry(new, path) is None and valid_claim_at(old, path))
        }
        return sorted({path for path, _ in trees.differences(old, new)} - as_rendered - claims)

    def _tree(self, revision: str | None = None) -> Tree:
        return trees.commit_of(self.objects, self.commit(revision)).tree

    def file_reader(self, revision: str | None = None) -> FileReader:
        return partial(trees.read_text, self._tree(revision))

    def config(self) -> Config:
        return snapshots.config_at(self._tree())

    def log(self, spec: str | None = None, path: str | None = None) -> Iterator[LogEntry]:
        # newest first; the commits up to REV, after A up to B in ``A..B``, or all
        since, until = self._sides(spec or "")
        since = since or None
        if path is not None:
            changes = commit_log.changes_to(self.objects, until, path, since)
            return (self._answered(entry) for entry, _, _ in changes)
        entries = (entry for _, entry in commit_log.commits(self.objects, until, since))
        return map(self._answered, entries)

    def _answered(self, entry: LogEntry) -> LogEntry:
        # which merges main has is looked up once, and only if somebody asks for a proposal's commit
        if PROPOSAL in entry.trailers and self._merged[0] != self._tip:
            self._merged = self._tip, commit_log.merges(self.objects, self._tip)
        return commit_log.answered(self.objects, entry, self._tip, self._merged[1])

    def revisions(self, spec: str | None) -> list[str]:
        # oldest first; the commit REV, those after A up to B in ``A..B``, or the newest one
        since, until = self._sides(spec or "")
        if since is None:
            return [until]
        if since not in ("", until) and not self.objects.descendant_of(until, since):
            first, _, last = (spec or "").partition("..")
            raise StateRepoError(
                f"{quoted(first)} is not in the history of {quoted(last or 'main')}: if it was "
                "there at an earlier audit, the history was rewritten since"
            )
        walked = commit_log.commits(self.objects, until, since or None)
        return [entry.commit for _, entry in walked][::-1]

    def _sides(self, spec: str) -> tuple[str | None, str]:
        # the commits after a time before the first commit are all, which an empty text says
        first, dots, last = spec.partition("..")
        if not dots:
            return None, self.commit(first)
        if not first:
            raise StateRepoError(f"'{spec}' has no start; write A..B")
        until = self.commit(last)
        try:
            return self.commit(first), until
        except BeforeTheFirst:
            return "", until

    def verify(
        self,
        commits: Sequence[str],
        *,
        whole: bool = False,
        progress: Progress = lambda done, total: None,
    ) -> list[Verdict]:
        verdicts = list[Verdict]()
        for verdict in verification.verify(self.objects, commits, whole=whole):
            verdicts.append(verdict)
            progress(len(verdicts), len(commits))
        return verdicts

    def history(self, path: str, revision: str, most: int) -> PathHistory:
        history = commit_log.history_of(self.objects, revision, path, most)
        return replace(
            history,
            started=history.started and self._answered(history.started),
            newest=tuple(map(self._answered, history.newest)),
            stopped=history.stopped and self._answered(history.stopped),
        )

    def changed_files(self, before: str, after: str, roots: Sequence[str] = ()) -> list[str]:
        changed = trees.differences(self._tree(before), self._tree(after), roots)
        return sorted(path for path, _ in changed)

    def base_of(self, commit: str) -> str:
        # the commit at which another one, of a proposal, left main
        base = self.objects.merge_base(self._tip, trees.commit_of(self.objects, commit).id)
        return str(base or self._tip)

    def changed_roots(self, commit: str) -> tuple[str, ...]:
        return tuple(sorted({path.split("/")[0] for path in self.files_changed_by(commit)}))

    def files_changed_by(self, commit: str) -> list[str]:
        after = trees.commit_of(self.objects, commit)
        return sorted(path for path, _ in trees.differences(trees.parent_tree(after), after.tree))

    def changes_node(self, commit: str, node: str) -> bool:
        opened = trees.commit_of(self.objects, commit)
        before, after = trees.parent_tree(opened), opened.tree
        if before is None:
            return False
        folder = naming.object_name("", node)
        for path, _ in trees.differences(before, after, (CLUSTERS_ROOT,)):
            parts = path.split("/")
            if len(parts) == 5 and parts[3] == folder:
                return True
        paths = ledger_files.changed_files(before, after)
        claims = (valid_claim_at(tree, path) for path in paths for tree in (before, after))
        return any(claim is not None and claim.held.needs(node) for claim in claims)

    def edits(self, entry: LogEntry, kind: str, name: str) -> bool:
        """Return whether a commit changes an override that selects a thing, or a node's entry.

        It is by a person, or by a generator that ends an override or takes over nodes.
        """
        operation = entry.first("Operation")
        if entry.by_generator and operation not in ("expire-override", "discover"):
            return False
        commit = trees.commit_of(self.objects, entry.commit)
        sides = trees.parent_tree(commit), commit.tree
        roots = (OVERRIDES_ROOT, "inventory") if kind == "node" else (OVERRIDES_ROOT,)
        paths = {path for path, _ in trees.differences(*sides, roots)}
        for path in paths | {*entry.trailers.get("Override", ())}:
            texts = [trees.read_text(side, path) or "" for side in sides]
            if path.startswith(f"{OVERRIDES_ROOT}/"):
                if any(override_selects(text, kind, name) for text in texts):
                    return True
            # as text, because a large inventory takes long to parse, and has many versions
            elif len({_item(text, name) for text in texts}) > 1:
                return True
        return False

    def person_commits_behind(self, entry: LogEntry, most: int) -> list[LogEntry]:
        since, follows = entry.first("Since"), entry.first("Follows")
        if not (entry.by_generator and since and follows):
            return []
        people = commit_log.person_commits(self.objects, follows, since)
        return [commit_log.entry_of(commit) for commit in islice(people, most)]

    def operator(self) -> Person:
        return commit_log.operator(self.objects.path)


def _item(text: str, id: str) -> str:
    named = re.compile(rf"\bid: *['\"]?{re.escape(id)}(?![\w/.-])")
    items = re.split(r"(?m)^(?=\s*- )", text)
    return next((item.strip() for item in items if named.search(item)), "")


@contextmanager
def opened(address: str, *, only_read: bool = True) -> Iterator[Reader]:
    # errors during the block become StateRepoError or Unsound too
    with (
        closing(Reader.of(address, only_read=only_read)) as reader,
        reading(address, reader.repository.objects),
    ):
        yield reader


@contextmanager
def opened_offline(address: str) -> Iterator[Reader | None]:
    """Yield a reader that does not use the network; None for a URL that nobody has cloned here."""
    if not is_url(address):
        with opened(address) as reader:
            yield reader
        return
    clones = sorted((settings.data_home(address) / "reader").glob("slot-*/clone.git"))
    if not clones:
        yield None
        return
    repository = repositories.LastFetch(clones[0])
    yield Reader(repository, repository.tip())
