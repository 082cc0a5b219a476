"""What a commit of the state repo says: configuration and ledger, loaded whole or brought forward.

Loading costs what is there, :func:`advance` what changed. A file that a person broke keeps its
last valid version in force and is reported; nothing else stops for it.
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
from demandops.demand.claim import Claim, ClaimKey, Subject
from demandops.errors import Fault, InvalidInput, fault
from demandops.ledger import claim_file, ended_override_file
from demandops.ledger.ledger import Ledger
from demandops.settings import GENERATED_ROOTS
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history import commit_message
from demandops.staterepo.load import last_valid_config
from demandops.staterepo.load.last_valid_config import Source

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
            path = claim_file.path_of(key)
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
    config_changed: bool

    def then(self, further: Advance) -> Advance:
        """Return both steps as one: ``further`` starts where this one ends."""
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
        progress: told (files read, files in all) while the ledger is read.

    Raises:
        InvalidInput: with every fault of every file.
        StateRepoError: where the commit holds no state repo.
    """
    commit = trees.commit_of(repo, revision)
    config = last_valid_config.config_at(commit.tree)
    ledger, keys, faults = _ledger_at(repo, commit.tree, progress)
    if faults:
        raise InvalidInput(faults)
    return Snapshot(commit.id, State.of(config, ledger), keys, sound=commit.id)


def load_last_valid(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Load a commit; of what is not valid there, the last version before it that was.

    Raises:
        InvalidInput, StateRepoError: where there never was a valid configuration.
    """
    commit = trees.commit_of(repo, revision)
    problems: list[Fault] = []
    try:
        config = last_valid_config.config_at(commit.tree)
    except InvalidInput as error:
        problems += error.faults
        config = last_valid_config.newest_valid(commit, error)
        config = config.with_ended_overrides(
            ended_override_file.read(last_valid_config.markers_at(commit.tree))
        )
    ledger, keys, faults = _ledger_at(repo, commit.tree, progress)
    for path in dict.fromkeys(found.file for found in faults):
        claim = _last_valid_claim(commit, path)
        if claim is not None:
            ledger, keys = ledger.replace(claim.key, claim), keys.insert(path, claim.key)
    problems += faults
    sound = None if problems else commit.id
    held = tuple(dict.fromkeys(found.file for found in faults))
    return Snapshot(commit.id, State.of(config, ledger), keys, tuple(problems), sound, held)


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


def _edited_by_hand(repo: Repository, before: Oid, to: Oid) -> bool:
    """Tell whether a commit that is not the generator's changed generated files on the way."""
    walker = repo.walk(to, SortMode.TOPOLOGICAL)
    walker.hide(before)
    for commit in walker:
        if commit_message.is_generators(commit.message) or not commit.parents:
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
        yield from trees.entries(tree[root], f"{root}/")  # type: ignore[arg-type]


def _text(repo: Repository, blob: Oid) -> str:
    return repo[blob].data.decode("utf-8", "replace")  # type: ignore[attr-defined,no-any-return]


def advance(repo: Repository, snapshot: Snapshot, to: Oid) -> Advance:
    """Bring a snapshot forward to another commit, reading only what differs.

    What is not valid there is left as it was before, and told in the new snapshot's problems.
    """
    before, after = trees.commit_of(repo, snapshot.commit).tree, trees.commit_of(repo, to).tree
    last_valid_config.refuse_other_rendering(after)
    state, problems = snapshot.state, list[Fault]()
    config_changed = _edited_by_hand(repo, snapshot.commit, to)
    source = snapshot.source
    if snapshot.problems or _differ(before, after, CONFIG_ROOTS):
        now = last_valid_config.found(
            repo, (snapshot.configuration, snapshot.sound), to, lambda files: _tried(files, state)
        )
        problems += now.faults
        source = now.source if problems else None
        if now.config is not None:
            config = now.config.with_ended_overrides(state.config.ended_overrides)
            config_changed = config_changed or config != state.config
            state = State(config, State.of(config, state.ledger).engine, state.ledger)
    ended = ended_override_file.read(last_valid_config.markers_at(after))
    if ended != state.config.ended_overrides:
        state = replace(state, config=state.config.with_ended_overrides(ended))
        config_changed = True
    ledger, keys, subjects, held = state.ledger, snapshot.keys, list[Subject](), list[str]()
    changed = dict(
        trees.differences(repo, _subtree(before, "ledger"), _subtree(after, "ledger"), "ledger/")
    )
    changed |= {path: trees.blob(after, path) for path in snapshot.held}
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
        config_changed,
    )


def _differ(one: Tree, other: Tree, roots: Iterable[str]) -> bool:
    return any(trees.id_of(one, root) != trees.id_of(other, root) for root in roots)


def _tried(files: Mapping[str, str], state: State) -> Config:
    """Return the configuration of a commit, tried on invented demands if it changed."""
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
    """What was read behind the published snapshot, and could not be built on yet.

    With writers that are faster, each try would read more than the one before, and be too late.
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
            known = known.then(advance(repo, known.snapshot, tip))
        self._known, self._start = known, before.commit
        return known
