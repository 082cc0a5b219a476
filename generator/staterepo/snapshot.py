"""What a commit of the state repo says: catalog and ledger, loaded whole or brought forward.

Loading costs what is there, :func:`advance` what changed. A file that a person broke keeps its
last valid version in force and is reported; nothing else stops for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import pygit2
from pygit2 import Commit, Oid, Repository, Tree
from pygit2.enums import SortMode
from rpds import HashTrieMap

from generator.catalog.catalog import CONFIG_ROOTS, Catalog
from generator.catalog.loading import load as load_catalog
from generator.catalog.repository import ROOT_FILE
from generator.decision import State, rehearse
from generator.demand.claim import Claim, ClaimKey, Subject
from generator.errors import Fault, InvalidInput, StateRepoError, fault
from generator.ledger import format as ledger_format
from generator.ledger import markers
from generator.ledger.ledger import Ledger
from generator.settings import GENERATED_ROOTS
from generator.staterepo import configuration, message
from generator.staterepo import tree as trees
from generator.staterepo.configuration import Source

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A commit and what it says.

    ``keys`` finds the claim behind a ledger file, so that a removed file is understood.
    ``problems`` are files that are not valid and whose last valid version is in force; ``sound`` is
    the newest commit without any; ``held`` are ledger files that are not in force as they stand;
    ``source`` is where the configuration in force is, where it is not the commit's own.
    """

    commit: Oid
    state: State
    keys: HashTrieMap[str, ClaimKey]
    problems: tuple[Fault, ...] = ()
    sound: Oid | None = None
    held: tuple[str, ...] = ()
    source: Source | None = None

    @property
    def configuration(self) -> Source:
        """Where the configuration in force is."""
        return self.source or Source(self.commit)

    def after(self, commit: Oid, state: State, changes: Iterable[ClaimKey]) -> Snapshot:
        """Return the snapshot of a commit of our own, whose state is known already."""
        keys = self.keys
        for key in changes:
            path = ledger_format.path_of(key)
            if state.ledger.get(key) is not None:
                keys = keys.insert(path, key)
            elif path in keys:
                keys = keys.remove(path)
        sound = self.sound if self.problems else commit
        return replace(self, commit=commit, state=state, keys=keys, sound=sound)


@dataclass(frozen=True, slots=True)
class Advance:
    """A snapshot brought forward: what people or other writers changed on the way."""

    snapshot: Snapshot
    subjects: tuple[Subject, ...]
    catalog_changed: bool

    def then(self, further: Advance) -> Advance:
        """Return both steps as one: ``further`` starts where this one ends."""
        return Advance(
            further.snapshot,
            tuple(dict.fromkeys((*self.subjects, *further.subjects))),
            self.catalog_changed or further.catalog_changed,
        )


def commit_of(repo: Repository, revision: str | Oid) -> Commit:
    """Return a commit by any name that Git knows.

    Raises:
        StateRepoError: where there is none.
    """
    try:
        found = repo[revision] if isinstance(revision, Oid) else repo.revparse_single(revision)
        return found.peel(Commit)
    except (KeyError, ValueError, pygit2.GitError):
        raise StateRepoError(
            f"'{revision}' is no commit of the state repo; `demandops log` lists them"
        ) from None


def load(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Load a commit whole.

    Args:
        progress: told (files read, files in all) while the ledger is read.

    Raises:
        InvalidInput: with every fault of every file.
        StateRepoError: where the commit holds no state repo.
    """
    commit = commit_of(repo, revision)
    catalog = configuration.catalog_at(commit.tree)
    ledger, keys, faults = _ledger_at(repo, commit.tree, progress)
    if faults:
        raise InvalidInput(faults)
    return Snapshot(commit.id, State.of(catalog, ledger), keys, sound=commit.id)


def load_last_valid(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Load a commit; of what is not valid there, the last version before it that was.

    Raises:
        InvalidInput, StateRepoError: where there never was a valid configuration.
    """
    commit = commit_of(repo, revision)
    problems: list[Fault] = []
    try:
        catalog = configuration.catalog_at(commit.tree)
    except InvalidInput as error:
        problems += error.faults
        catalog = configuration.last_valid_catalog(commit, error)
        catalog = catalog.with_ended(markers.read(configuration.markers_at(commit.tree)))
    ledger, keys, faults = _ledger_at(repo, commit.tree, progress)
    for path in dict.fromkeys(found.file for found in faults):
        claim = _last_valid_claim(commit, path)
        if claim is not None:
            ledger, keys = ledger.replace(claim.key, claim), keys.insert(path, claim.key)
    problems += faults
    sound = None if problems else commit.id
    held = tuple(dict.fromkeys(found.file for found in faults))
    return Snapshot(commit.id, State.of(catalog, ledger), keys, tuple(problems), sound, held)


def _last_valid_claim(commit: Commit, path: str) -> Claim | None:
    while commit.parents:
        commit = commit.parents[0]
        text = trees.read_text(commit.tree, path)
        if text is None:
            return None
        try:
            return ledger_format.read(text, path)
        except InvalidInput:
            continue
    return None


def _edited_by_hand(repo: Repository, before: Oid, to: Oid) -> bool:
    """Tell whether a commit that is not the generator's changed generated files on the way."""
    walker = repo.walk(to, SortMode.TOPOLOGICAL)
    walker.hide(before)
    for commit in walker:
        if message.is_generators(commit.message) or not commit.parents:
            continue
        if _differ(commit.parents[0].tree, commit.tree, GENERATED_ROOTS):
            return True
    return False


def _ledger_at(
    repo: Repository, tree: Tree, progress: Progress
) -> tuple[Ledger, HashTrieMap[str, ClaimKey], list[Fault]]:
    paths = [(path, blob) for path, blob in _ledger_files(tree) if ledger_format.kind_of(path)]
    ledger, faults = Ledger(), list[Fault]()
    keys: HashTrieMap[str, ClaimKey] = HashTrieMap()
    for done, (path, blob) in enumerate(paths):
        if done % 200 == 0:
            progress(done, len(paths))
        try:
            claim = ledger_format.read(_text(repo, blob), path)
        except InvalidInput as error:
            faults += error.faults
            continue
        ledger = ledger.replace(claim.key, claim)
        keys = keys.insert(path, claim.key)
    progress(len(paths), len(paths))
    return ledger, keys, faults


def _ledger_files(tree: Tree) -> Iterable[tuple[str, Oid]]:
    root = ledger_format.LEDGER_ROOT
    if root in tree and isinstance(tree[root], Tree):
        yield from trees.entries(tree[root], f"{root}/")  # type: ignore[arg-type]


def _text(repo: Repository, blob: Oid) -> str:
    return repo[blob].data.decode("utf-8", "replace")  # type: ignore[attr-defined,no-any-return]


def advance(repo: Repository, snapshot: Snapshot, to: Oid) -> Advance:
    """Bring a snapshot forward to another commit, reading only what differs.

    What is not valid there is left as it was before, and told in the new snapshot's problems.
    """
    before, after = commit_of(repo, snapshot.commit).tree, commit_of(repo, to).tree
    configuration.refuse_other_rendering(after)
    state, problems = snapshot.state, list[Fault]()
    catalog_changed = _edited_by_hand(repo, snapshot.commit, to)
    source = snapshot.source
    if snapshot.problems or _differ(before, after, CONFIG_ROOTS):
        now = configuration.found(
            repo, (snapshot.configuration, snapshot.sound), to, lambda files: _tried(files, state)
        )
        problems += now.faults
        source = now.source if problems else None
        if now.catalog is not None:
            catalog = now.catalog.with_ended(state.catalog.ended)
            catalog_changed = catalog_changed or catalog != state.catalog
            state = State(catalog, State.of(catalog, state.ledger).engine, state.ledger)
    ended = markers.read(configuration.markers_at(after))
    if ended != state.catalog.ended:
        state = replace(state, catalog=state.catalog.with_ended(ended))
        catalog_changed = True
    ledger, keys, subjects, held = state.ledger, snapshot.keys, list[Subject](), list[str]()
    changed = dict(
        trees.differences(repo, _subtree(before, "ledger"), _subtree(after, "ledger"), "ledger/")
    )
    changed |= {path: trees.blob(after, path) for path in snapshot.held}
    for path, blob in sorted(changed.items()):
        if ledger_format.kind_of(path) is None:
            continue
        known = keys.get(path)
        if blob is None:
            if known is not None:
                ledger = ledger.replace(known, None)
                subjects.append(known.subject)
                keys = keys.remove(path)
            continue
        try:
            claim = ledger_format.read(_text(repo, blob), path)
        except InvalidInput as error:
            problems += error.faults
            held.append(path)
            continue
        if ledger.get(claim.key) != claim:
            ledger = ledger.replace(claim.key, claim)
            subjects.append(claim.subject)
        keys = keys.insert(path, claim.key)
    state, sound = replace(state, ledger=ledger), snapshot.sound if problems else to
    return Advance(
        Snapshot(to, state, keys, tuple(problems), sound, tuple(held), source),
        tuple(dict.fromkeys(subjects)),
        catalog_changed,
    )


def _differ(one: Tree, other: Tree, roots: Iterable[str]) -> bool:
    return any(trees.id_of(one, root) != trees.id_of(other, root) for root in roots)


def _tried(files: Mapping[str, str], state: State) -> Catalog:
    """Return the catalog of a commit, tried on invented demands where it is another than before."""
    if ROOT_FILE not in files:
        raise InvalidInput([fault("", configuration.NO_STATE_REPO).within(ROOT_FILE)])
    catalog = load_catalog(files)
    if catalog.with_ended(state.catalog.ended) != state.catalog:
        rehearse(State.of(catalog, Ledger()))
    return catalog


def _subtree(tree: Tree, name: str) -> Tree | None:
    entry = trees.child(tree, name)
    return entry if isinstance(entry, Tree) else None
