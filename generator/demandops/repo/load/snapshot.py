"""A commit's configuration and ledger, loaded whole or advanced from an earlier commit.

:func:`load` reads all files, :func:`advance` only those that changed. If a file is not valid, its
last valid version stays in effect and the file is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

from pygit2 import Blob, Oid, Repository, Tree

from demandops.base.errors import Fault, InvalidInput, OverLimit, fault
from demandops.base.naming import Subject
from demandops.base.settings import GENERATED_ROOTS
from demandops.decide.state import State, try_configuration
from demandops.model.config.config import CONFIG_ROOTS, Config
from demandops.model.config.load import load as load_config
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import ClaimChange, Ledger
from demandops.repo.git import tree as trees
from demandops.repo.history import commit_log
from demandops.repo.load import last_valid_config, ledger_files
from demandops.repo.load.last_valid_config import ConfigSource, LastValidConfig
from demandops.templating.evaluator import DEMAND_S, EVALUATE, processor_time

Progress = Callable[[int, int], None]

# The folders and files that a snapshot is read from.
ROOTS = (*CONFIG_ROOTS, claim_files.LEDGER_ROOT)


@dataclass(frozen=True, slots=True)
class Snapshot:
    commit: Oid
    state: State
    last_valid_commit: Oid  # the newest commit without problems
    # the faults of invalid files, whose last valid versions are in effect
    problems: tuple[Fault, ...] = ()
    # ledger files whose content at this commit is not in effect
    quarantined_files: tuple[str, ...] = ()
    # the source of the configuration in effect; None means this commit
    other_config_source: ConfigSource | None = None
    # whether a generator has written the files of this state; if not, all must be rendered
    is_rendered: bool = True

    @property
    def config_source(self) -> ConfigSource:
        return self.other_config_source or ConfigSource(self.commit)

    def with_commit(self, commit: Oid, state: State) -> Snapshot:
        last_valid_commit = self.last_valid_commit if self.problems else commit
        return replace(self, commit=commit, state=state, last_valid_commit=last_valid_commit)


@dataclass(frozen=True, slots=True)
class Advance:
    snapshot: Snapshot
    subjects: tuple[Subject, ...]  # those whose claims changed
    # all releases must be rendered again, usually because the configuration changed
    config_changed: bool


def load(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    # ``progress`` gets the numbers of read and of all claim files
    commit = trees.commit_of(repo, revision)
    config = last_valid_config.config_at(commit.tree)
    files = ledger_files.read_claims(_claim_texts(commit.tree, progress))
    if files.faults:
        raise InvalidInput(files.faults)
    ended = last_valid_config.ended_overrides_at(commit.tree)
    waits = records.read_all_waiting(trees.texts(commit.tree, (records.WAITING_ROOT,)))
    ledger = replace(files.ledger(), ended=ended, waiting=waits)
    return Snapshot(commit.id, State(config, ledger, EVALUATE), commit.id)


def _claim_texts(tree: Tree, progress: Progress) -> Iterator[tuple[str, str]]:
    blobs: list[tuple[str, Blob]] = [
        (path, blob)
        for path, blob in trees.blobs(tree, (claim_files.LEDGER_ROOT,))
        if claim_files.kind_of(path)
    ]
    for done, (path, blob) in enumerate(blobs):
        if done % 200 == 0:
            progress(done, len(blobs))
        yield path, trees.text_of(blob)
    progress(len(blobs), len(blobs))


def advance(
    repo: Repository, before: Snapshot, to: Oid, recorded: ConfigSource | None = None
) -> Advance:
    """Return the snapshot of the commit ``to``, and the changes since the snapshot ``before``.

    Only files that differ are read. ``recorded`` is the recorded source of the configuration in
    effect at ``to``; if its files are not valid, InvalidInput is raised.
    """
    old, new = trees.commit_of(repo, before.commit).tree, trees.commit_of(repo, to).tree
    state, in_effect = before.state, LastValidConfig(None, before.config_source, ())
    if recorded is not None:
        in_effect = LastValidConfig(load_config(recorded.texts(repo)), recorded, ())
    elif before.problems or trees.differ(old, new, CONFIG_ROOTS):
        in_effect = _last_valid_config(repo, before, to)
    config, ended = in_effect.config or state.config, last_valid_config.ended_overrides_at(new)
    world_changed = config != state.config or ended != state.ledger.ended
    config_changed = (
        world_changed or not before.is_rendered or _must_render_all(repo, before.commit, to)
    )
    waits = state.ledger.waiting
    if trees.differ(old, new, (records.WAITING_ROOT,)):
        waits = records.read_all_waiting(trees.texts(new, (records.WAITING_ROOT,)))
    ledger = replace(state.ledger, ended=ended, waiting=waits)
    state = State(config, ledger, EVALUATE) if in_effect.config else replace(state, ledger=ledger)
    problems, claims, invalid = list(in_effect.faults), dict[str, Claim | None](), list[str]()
    # a quarantined file is read again, because another change may have made it valid
    for path in sorted({*ledger_files.changed_files(old, new), *before.quarantined_files}):
        try:
            claims[path] = claim = ledger_files.claim_at(new, path)
            # the owner of a path is sought in the whole ledger, and only of a replaced file
            if trees.entry(old, path) and (
                faults := list(ledger_files.owner_faults(claim, path, state.ledger))
            ):
                raise InvalidInput(faults)
        except InvalidInput as error:
            problems += error.faults
            invalid.append(path)
    claims |= ledger_files.last_valid_claims(repo, before.last_valid_commit, to, invalid)
    ledger, changes = state.ledger, list[ClaimChange]()
    for path in sorted(claims):
        claim = claims[path]
        keyed = claim or ledger_files.valid_claim_at(old, path)
        key = keyed.key if keyed else ledger_files.key_of(path, ledger)
        if key is not None and ledger.get(key) != claim:
            changes.append(ClaimChange(ledger.get(key), claim))
            ledger = ledger.replace(key, claim)
    if world_changed:
        state = replace(state, ledger=ledger)
    else:
        state = before.state.with_ledger(ledger, changes)
    snapshot = Snapshot(
        to,
        state,
        before.last_valid_commit if problems else to,
        tuple(problems),
        tuple(invalid),
        in_effect.source if in_effect.faults or recorded else None,
    )
    subjects = dict.fromkeys(change.key.subject for change in changes)
    return Advance(snapshot, tuple(subjects), config_changed)


def _must_render_all(repo: Repository, before: Oid, to: Oid) -> bool:
    # people may have changed generated files since ``before``
    people = list(commit_log.person_commits(repo, to, before))
    # where a generator made the newest commit, the generated files match the ledger
    if not people or people[0].id != to:
        return False
    # a person's commit may undo what another generator has committed meanwhile
    is_alone = len(people) == sum(1 for _ in commit_log.commits(repo, to, before))
    roots = GENERATED_ROOTS if is_alone else (*GENERATED_ROOTS, *ROOTS)
    return any(
        trees.differ(commit.parents[0].tree, commit.tree, roots)
        for commit in people
        if commit.parents
    )


# By their arguments, the newest results of _last_valid_config: an invalid file is judged only once,
# and not again for each demand.
_judged: dict[object, LastValidConfig] = {}
_MOST_JUDGED = 8


def _last_valid_config(repo: Repository, before: Snapshot, to: Oid) -> LastValidConfig:
    key = (
        frozenset(before.config_source.files(repo).items()),
        frozenset(ConfigSource(to).files(repo).items()),
        before.last_valid_commit,
        frozenset(before.state.ledger.ended.items()),
    )
    result = _judged.get(key)
    if result is None:
        result = last_valid_config.load_last_valid_config(
            repo,
            before.config_source,
            before.last_valid_commit,
            to,
            lambda files: _load_and_rehearse(files, before.state),
        )
        if len(_judged) >= _MOST_JUDGED:
            _judged.clear()
        _judged[key] = result
    # a result may be of another commit with the same files
    if result.config is None:
        return replace(result, source=before.config_source)
    return replace(result, source=replace(result.source, commit=to))


def _load_and_rehearse(files: Mapping[str, str], state: State) -> Config:
    if ROOT_FILE not in files:
        raise InvalidInput([fault("", last_valid_config.NO_STATE_REPO).within(ROOT_FILE)])
    config, in_force = load_config(files), state.config.repo_settings.render_version
    if config.repo_settings.render_version < in_force:
        message = f"is lower than {in_force}, which `demandops upgrade` wrote; write {in_force}"
        raise InvalidInput([fault("renderVersion", message).within(ROOT_FILE)])
    if config != state.config:  # a new one must render samples
        # what takes too long is a fault for `check`, and of each demand that needs it; whether a
        # configuration is valid must not depend on the machine
        with suppress(OverLimit), processor_time(each=DEMAND_S, together=4 * DEMAND_S):
            try_configuration(State(config, Ledger(ended=state.ledger.ended), EVALUATE))
    return config


class ReadAhead:
    # Reading takes time. If each attempt to publish read all commits since this generator's last
    # publication, and not only the newer ones, other generators could publish first every time.
    def __init__(self) -> None:
        self._so_far: Advance | None = None
        self._start: Oid | None = None

    def advance(self, repo: Repository, before: Snapshot, tip: Oid) -> Advance:
        last_valid_config.refuse_other_render_version(repo, tip)
        so_far = self._so_far
        if so_far is None or self._start != before.commit:
            so_far = Advance(before, (), False)
        start = so_far.snapshot
        if start.commit != tip or start.problems or not start.is_rendered:
            later = advance(repo, start, tip)
            so_far = Advance(
                later.snapshot,
                tuple(dict.fromkeys((*so_far.subjects, *later.subjects))),
                so_far.config_changed
                or later.config_changed
                or (start.commit != before.commit and _must_render_all(repo, before.commit, tip)),
            )
        self._so_far, self._start = so_far, before.commit
        return so_far
