"""A commit's configuration and ledger, loaded whole or advanced from an earlier commit.

:func:`load` reads all files, :func:`advance` only those that changed. If a file is not valid, its
last valid version stays in effect and the file is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

from pygit2 import Commit, Oid, Repository, Tree
from pygit2.enums import SortMode
from rpds import HashTrieMap

from demandops.config.config import CONFIG_ROOTS, Config
from demandops.config.load import load as load_config
from demandops.config.repo_settings import ROOT_FILE
from demandops.decision import State, try_configuration
from demandops.demand.claim import Claim, ClaimKey
from demandops.errors import Fault, InvalidInput, fault
from demandops.ledger import claim_file, ended_override_file
from demandops.ledger.ledger import Ledger
from demandops.settings import GENERATED_ROOTS
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history import commit_message
from demandops.staterepo.load import last_valid_config
from demandops.staterepo.load.last_valid_config import ConfigSource
from demandops.subject import Subject

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A commit and its state: configuration and ledger.

    ``keys``: the claim of each ledger file, so that the claim of a removed file is known.
    ``problems``: what is not valid; the last valid versions are in effect instead.
    ``last_valid_commit``: the newest commit without problems.
    ``quarantined_files``: ledger files whose content at this commit is not in effect.
    ``other_config_source``: the source of the configuration in effect, if not this commit.
    """

    commit: Oid
    state: State
    keys: HashTrieMap[str, ClaimKey]
    problems: tuple[Fault, ...] = ()
    last_valid_commit: Oid | None = None
    quarantined_files: tuple[str, ...] = ()
    other_config_source: ConfigSource | None = None

    @property
    def config_source(self) -> ConfigSource:
        """The source of the configuration in effect."""
        return self.other_config_source or ConfigSource(self.commit)

    def with_commit(self, commit: Oid, state: State, changes: Iterable[ClaimKey]) -> Snapshot:
        """Return the snapshot of a new commit by this program, whose state is known."""
        keys = self.keys
        for key in changes:
            path = claim_file.path_of(key)
            if state.ledger.get(key) is not None:
                keys = keys.insert(path, key)
            elif path in keys:
                keys = keys.remove(path)
        last_valid_commit = self.last_valid_commit if self.problems else commit
        return replace(
            self, commit=commit, state=state, keys=keys, last_valid_commit=last_valid_commit
        )


@dataclass(frozen=True, slots=True)
class Advance:
    """A later snapshot, and the subjects that changed since the earlier one."""

    snapshot: Snapshot
    subjects: tuple[Subject, ...]
    config_changed: bool

    def followed_by(self, further: Advance) -> Advance:
        """Return this advance and the next one, ``further``, as one."""
        return Advance(
            further.snapshot,
            tuple(dict.fromkeys((*self.subjects, *further.subjects))),
            self.config_changed or further.config_changed,
        )


def load(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Load a commit whole.

    Args:
        progress: called with (files read, all files) while the ledger is read.

    Raises:
        InvalidInput: every fault of every file.
        StateRepoError: the commit is not a state repo.
    """
    commit = trees.commit_of(repo, revision)
    config = last_valid_config.config_at(commit.tree)
    ledger, keys, faults = _ledger_at(repo, commit.tree, progress)
    if faults:
        raise InvalidInput(faults)
    return Snapshot(commit.id, State.of(config, ledger), keys, last_valid_commit=commit.id)


def load_last_valid(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Load a commit, with last valid versions of the files that are not valid.

    Raises:
        InvalidInput, StateRepoError: there never was a valid configuration.
    """
    commit = trees.commit_of(repo, revision)
    problems: list[Fault] = []
    try:
        config = last_valid_config.config_at(commit.tree)
    except InvalidInput as error:
        problems += error.faults
        config = last_valid_config.newest_valid_config(commit, error)
        config = config.with_ended_overrides(
            ended_override_file.read(last_valid_config.end_markers_at(commit.tree))
        )
    ledger, keys, faults = _ledger_at(repo, commit.tree, progress)
    for path in dict.fromkeys(found.file for found in faults):
        claim = _last_valid_claim(commit, path)
        if claim is not None:
            ledger, keys = ledger.replace(claim.key, claim), keys.insert(path, claim.key)
    problems += faults
    last_valid_commit = None if problems else commit.id
    quarantined = tuple(dict.fromkeys(fault.file for fault in faults))
    return Snapshot(
        commit.id, State.of(config, ledger), keys, tuple(problems), last_valid_commit, quarantined
    )


def _last_valid_claim(commit: Commit, path: str) -> Claim | None:
    while commit.parents:
        commit = commit.parents[0]
        text = trees.read_text(commit.tree, path)
        if text is None:
            return None
        try:
            return claim_file.read(text, path)
        except InvalidInput:
            continue
    return None


def _has_manual_edit(repo: Repository, before: Oid, to: Oid) -> bool:
    """Return whether a person changed generated files between two commits."""
    walker = repo.walk(to, SortMode.TOPOLOGICAL)
    walker.hide(before)
    for commit in walker:
        if commit_message.is_by_generator(commit.message) or not commit.parents:
            continue
        if _differ(commit.parents[0].tree, commit.tree, GENERATED_ROOTS):
            return True
    return False


def _ledger_at(
    repo: Repository, tree: Tree, progress: Progress
) -> tuple[Ledger, HashTrieMap[str, ClaimKey], list[Fault]]:
    paths = [(path, blob) for path, blob in _ledger_files(tree) if claim_file.kind_of(path)]
    ledger, faults = Ledger(), list[Fault]()
    keys: HashTrieMap[str, ClaimKey] = HashTrieMap()
    for done, (path, blob) in enumerate(paths):
        if done % 200 == 0:
            progress(done, len(paths))
        try:
            claim = claim_file.read(_text(repo, blob), path)
        except InvalidInput as error:
            faults += error.faults
            continue
        ledger = ledger.replace(claim.key, claim)
        keys = keys.insert(path, claim.key)
    progress(len(paths), len(paths))
    return ledger, keys, faults


def _ledger_files(tree: Tree) -> Iterable[tuple[str, Oid]]:
    root = claim_file.LEDGER_ROOT
    if root in tree and isinstance(tree[root], Tree):
        yield from trees.files_below(tree[root], f"{root}/")  # type: ignore[arg-type]


def _text(repo: Repository, blob: Oid) -> str:
    return repo[blob].data.decode("utf-8", "replace")  # type: ignore[attr-defined,no-any-return]


def advance(repo: Repository, snapshot: Snapshot, to: Oid) -> Advance:
    """Advance a snapshot to another commit, reading only what differs.

    What is not valid stays as it was and is listed in the new snapshot's problems.
    """
    before, after = trees.commit_of(repo, snapshot.commit).tree, trees.commit_of(repo, to).tree
    last_valid_config.refuse_other_render_version(after)
    state, problems = snapshot.state, list[Fault]()
    config_changed = _has_manual_edit(repo, snapshot.commit, to)
    source = snapshot.other_config_source
    if snapshot.problems or _differ(before, after, CONFIG_ROOTS):
        valid = last_valid_config.load_last_valid_config(
            repo,
            snapshot.config_source,
            snapshot.last_valid_commit,
            to,
            lambda files: _load_and_rehearse(files, state),
        )
        problems += valid.faults
        source = valid.source if problems else None
        if valid.config is not None:
            config = valid.config.with_ended_overrides(state.config.ended_overrides)
            config_changed = config_changed or config != state.config
            state = State(config, State.of(config, state.ledger).engine, state.ledger)
    ended = ended_override_file.read(last_valid_config.end_markers_at(after))
    if ended != state.config.ended_overrides:
        state = replace(state, config=state.config.with_ended_overrides(ended))
        config_changed = True
    ledger, keys, subjects, invalid = state.ledger, snapshot.keys, list[Subject](), list[str]()
    changed = dict(
        trees.differences(repo, _subtree(before, "ledger"), _subtree(after, "ledger"), "ledger/")
    )
    changed |= {path: trees.blob_id(after, path) for path in snapshot.quarantined_files}
    for path, blob in sorted(changed.items()):
        if claim_file.kind_of(path) is None:
            continue
        known = keys.get(path)
        if blob is None:
            if known is not None:
                ledger = ledger.replace(known, None)
                subjects.append(known.subject)
                keys = keys.remove(path)
            continue
        try:
            claim = claim_file.read(_text(repo, blob), path)
        except InvalidInput as error:
            problems += error.faults
            invalid.append(path)
            continue
        if ledger.get(claim.key) != claim:
            ledger = ledger.replace(claim.key, claim)
            subjects.append(claim.subject)
        keys = keys.insert(path, claim.key)
    state = replace(state, ledger=ledger)
    last_valid_commit = snapshot.last_valid_commit if problems else to
    return Advance(
        Snapshot(to, state, keys, tuple(problems), last_valid_commit, tuple(invalid), source),
        tuple(dict.fromkeys(subjects)),
        config_changed,
    )


def _differ(one: Tree, other: Tree, roots: Iterable[str]) -> bool:
    return any(trees.entry_id(one, root) != trees.entry_id(other, root) for root in roots)


def _load_and_rehearse(files: Mapping[str, str], state: State) -> Config:
    """Return the configuration of these files; if it changed, render sample demands with it."""
    if ROOT_FILE not in files:
        raise InvalidInput([fault("", last_valid_config.NO_STATE_REPO).within(ROOT_FILE)])
    config = load_config(files)
    if config.with_ended_overrides(state.config.ended_overrides) != state.config:
        try_configuration(State.of(config, Ledger()))
    return config


def _subtree(tree: Tree, name: str) -> Tree | None:
    entry = trees.child(tree, name)
    return entry if isinstance(entry, Tree) else None


class ReadAhead:
    """Remembers what was read after the published snapshot until a commit is published on it.

    If other writers are faster, each attempt would otherwise read more and again be too late.
    """

    def __init__(self) -> None:
        self._known: Advance | None = None
        self._start: Oid | None = None

    def advance(self, repo: Repository, before: Snapshot, tip: Oid) -> Advance:
        """Return what differs between ``before`` and ``tip``."""
        known = self._known
        if known is None or self._start != before.commit:
            known = Advance(before, (), False)
        if known.snapshot.commit != tip or known.snapshot.problems:
            known = known.followed_by(advance(repo, known.snapshot, tip))
        self._known, self._start = known, before.commit
        return known
